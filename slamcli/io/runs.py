"""A finished map read back: where its frames are, how its camera saw, where each frame stood."""

from __future__ import annotations

import csv
import io
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.core.records import PoseEstimate, Status
from slamcli.io.files import read_text
from slamcli.io.toml import Scalar

_NUMBERS = (
    "height_metres",
    "pitch_radians",
    "roll_radians",
    "max_range_metres",
    "focal_sigma_pixels",
    "height_sigma_metres",
    "pitch_sigma_radians",
    "roll_sigma_radians",
)


@dataclass(frozen=True, slots=True, eq=False)
class FinishedRun:
    """What `slam stitch` left in its output.

    Attributes
    ----------
    sources : tuple of Path
        Folders and files of the frames.
    calibration : Calibration
        As the run used it.
    estimates : tuple of PoseEstimate
        Of the placed frames.
    """

    sources: tuple[Path, ...]
    calibration: Calibration
    estimates: tuple[PoseEstimate, ...]


def camera_section(calibration: Calibration) -> dict[str, Scalar]:
    """Return a calibration as a table of run.toml, every number in full."""
    section: dict[str, Scalar] = {
        "camera_matrix": tuple(map(float, calibration.camera_matrix.ravel())),
        "distortion": tuple(map(float, calibration.distortion.ravel())),
        "distortion_model": calibration.distortion_model,
        "image_size": tuple(map(float, calibration.image_size)),
        "robot_from_image": tuple(map(float, calibration.robot_from_image.ravel())),
        "unit": calibration.unit,
    }
    for name in _NUMBERS:
        section[name] = float(getattr(calibration, name))
    return section


def source_text(sources: Sequence[Path]) -> tuple[str, ...]:
    """Return where frames are, as seen from anywhere."""
    return tuple(str(source.absolute()) for source in sources)


def read_run(folder: Path) -> FinishedRun:
    """Return a finished map's run.

    Parameters
    ----------
    folder : Path
        The output of `slam stitch`, or any file in it.

    Raises
    ------
    InputError
    """
    place = folder if folder.is_dir() else folder.parent
    path = place / "run.toml"
    text = read_text(path, "run (the output folder of slam stitch is needed)")
    try:
        told = tomllib.loads(text)
        sources = tuple(Path(source) for source in told["sources"])
        calibration = _calibration(told["camera"])
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} does not tell of a map that can be painted again ({error}); "
            "make it anew with slam stitch"
        ) from error
    return FinishedRun(sources, calibration, _placed(place / "poses.csv"))


def _calibration(section: dict[str, Any]) -> Calibration:
    width, height = section["image_size"]
    return Calibration(
        camera_matrix=np.array(section["camera_matrix"], np.float64).reshape(3, 3),
        distortion=np.array(section["distortion"], np.float64),
        distortion_model=section["distortion_model"],
        image_size=(int(width), int(height)),
        robot_from_image=np.array(section["robot_from_image"], np.float64).reshape(3, 3),
        unit=section["unit"],
        **{name: float(section[name]) for name in _NUMBERS},
    )


def _placed(path: Path) -> tuple[PoseEstimate, ...]:
    found = []
    rows = csv.DictReader(io.StringIO(read_text(path, "poses")))
    for number, row in enumerate(rows, start=2):
        if not row.get("x"):
            continue
        try:
            pose = Pose2(float(row["x"]), float(row["y"]), float(row["heading"]))
            stamp = float(row["stamp"]) if row["stamp"] else None
            index, fragment = int(row["index"]), int(row["fragment"])
            told = [row[name] for name in ("rocking_pitch", "rocking_roll", "rocking_height")]
            rocking = Rocking(*map(float, told)) if all(told) else None
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{path}, line {number}: not a row of poses ({error})") from error
        status: Status = "predicted" if row.get("status") == "predicted" else "tracked"
        found.append(
            PoseEstimate(index, row["frame"], stamp, pose, status, "", fragment, rocking=rocking)
        )
    if not found:
        raise InputError(f"{path} has no placed frame; there is nothing to paint")
    return tuple(found)
