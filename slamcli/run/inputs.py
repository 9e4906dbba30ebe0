"""What every command that reads frames opens first: the list, and the camera that took them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.errors import CalibrationError, FrameError, InputError
from slamcli.io.calibrations import load_calibration
from slamcli.io.frames import FrameFile, list_frames, read_frame

CALIBRATION_NAME = "calibration.yaml"


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Frames and their camera.

    Attributes
    ----------
    files : list of FrameFile
    calibration : Calibration
    calibration_path : Path or None
        None when the frames are taken as top-down pictures in pixel units.
    note : str
        Which calibration was chosen, for the user; empty when it was named.
    """

    files: list[FrameFile]
    calibration: Calibration
    calibration_path: Path | None
    note: str


def open_inputs(
    sources: Sequence[Path],
    calibration_path: Path | None,
    frame_rate: float | None = None,
    max_range_metres: float | None = None,
) -> Inputs:
    """List the frames and find their calibration: named, else in their folder, else none.

    Raises
    ------
    InputError, CalibrationError
        When there is no frame, none that can be read, or the calibration is broken or of another
        image size than every frame that can be read.
    """
    files = list_frames(sources, frame_rate)
    path, note = calibration_path, ""
    if path is None:
        path = next((place for place in _places(sources, files) if place.is_file()), None)
        note = "" if path is None else f"calibration found: {path}"
    if path is None:
        calibration = top_down_calibration(_first_size(files))
        return Inputs(files, calibration, None, "no calibration: top-down frames, pixel units")
    calibration = load_calibration(path)
    if max_range_metres is not None:
        calibration = replace(calibration, max_range_metres=max_range_metres)
    check_size(files, calibration, path)
    return Inputs(files, calibration, path, note)


def _places(sources: Sequence[Path], files: Sequence[FrameFile]) -> list[Path]:
    folders = [source for source in sources if source.is_dir()]
    folders += [files[0].path.parent]
    return [folder / CALIBRATION_NAME for folder in folders]


def _first_size(files: Sequence[FrameFile]) -> tuple[int, int]:
    """Return width and height of the first frame that can be read."""
    reason = ""
    for file in files:
        try:
            image = read_frame(file).image
        except FrameError as error:
            reason = reason or f"{file.name}: {error}"
            continue
        return image.shape[1], image.shape[0]
    raise InputError(f"none of the {len(files)} frames can be read; the first, {reason}")


def check_size(files: Sequence[FrameFile], calibration: Calibration, path: Path) -> None:
    """Refuse a calibration of another image size early, not once for every frame."""
    size = _first_size(files)
    if size == calibration.image_size:
        return
    wanted = calibration.image_size
    for file in files:
        try:
            image = read_frame(file).image
        except FrameError:
            continue
        if (image.shape[1], image.shape[0]) == wanted:
            return
    raise CalibrationError(
        f"{path} is for {wanted[0]}x{wanted[1]} images, but the frames have {size[0]}x{size[1]}; "
        "calibrate with a photo of the frames' size"
    )
