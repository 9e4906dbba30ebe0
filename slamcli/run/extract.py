"""`slam extract`: what a video, a bag or photos hold, as the files that the other commands read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from slamcli.core.config import FrameSelection
from slamcli.core.errors import InputError, SlamcliError
from slamcli.core.telemetry import GPS_SIGMA_METRES
from slamcli.io.containers.bag import is_bag
from slamcli.io.containers.bag_frames import BagFrame
from slamcli.io.containers.bag_readings import antenna_metres, camera_info
from slamcli.io.containers.listing import is_container
from slamcli.io.files import write_bytes, write_image, write_text
from slamcli.io.frames import FrameFile, list_frames
from slamcli.io.outputs import output_folder
from slamcli.io.picture_files import photo_info_of
from slamcli.io.telemetry import (
    read_compass,
    read_gps,
    read_odometry,
    write_compass,
    write_gps,
    write_odometry,
)
from slamcli.run.command_report import Report
from slamcli.run.inputs import taken_notes
from slamcli.run.per_frame import Skipped, each_frame
from slamcli.run.session.session import Session

FRAMES, LENS = "frames", "camera_info.yaml"
ODOMETRY, GPS, COMPASS = "odometry.csv", "gps.csv", "compass.csv"
PRODUCTS = (FRAMES, LENS, ODOMETRY, GPS, COMPASS)


def extract(
    sources: Sequence[Path],
    output: Path,
    *,
    selection: FrameSelection | None = None,
    overwrite: bool,
    session: Session,
) -> Report:
    """Write the frames, named by their stamps, and all readings.

    Raises
    ------
    InputError, OutputError
        InputError also when no frame at all can be read, or two have the same name.
    """
    files = list_frames(sources, None, selection, session.progress)
    names = [file.name for file in files]
    if len(set(names)) < len(names):
        raise InputError("two frames have the same name; give their folders one at a time")
    inputs = list(dict.fromkeys(file.path for file in files))
    with output_folder(output, PRODUCTS, inputs=inputs, overwrite=overwrite) as staging:
        (staging / FRAMES).mkdir()
        work = partial(_write_frame, staging / FRAMES)
        results = each_frame("extracting", work, files, session)
        skipped = [one.reason for one in results if isinstance(one, Skipped)]
        readings = _of_photos(files, staging)
        readings += [
            line for path in inputs if is_bag(path) for line in _of_bag(path, files, staging)
        ]
    lines = [
        *taken_notes(files),
        *(f"skipped {reason}" for reason in skipped),
        f"{'frames':<12} {len(files) - len(skipped)}, in {output / FRAMES}",
        *readings,
        f"{'written to':<12} {output}",
    ]
    facts = {
        "frames": len(files) - len(skipped),
        "skipped": skipped,
        "readings": readings,
        "output": output,
    }
    return Report(tuple(lines), facts)


def _write_frame(folder: Path, file: FrameFile) -> None:
    """Write a picture as it is stored, or pixels as PNG; raises FrameError.

    A PNG has its stamp in its name: the photo's notes are lost.
    """
    content = file.content()
    if isinstance(content, bytes):
        write_bytes(folder / file.name, content)
        return
    name = Path(file.name).stem if file.stamp is None else f"{file.stamp:.6f}"
    write_image(folder / f"{name}.png", content)


def _of_photos(files: Sequence[FrameFile], staging: Path) -> list[str]:
    """Write the places that photos have, by the stamps of their frames; return a line for them."""
    photos = [file for file in files if not is_container(file.path) and file.stamp is not None]
    infos = [(file.stamp, photo_info_of(file.path)) for file in photos]
    placed = [(s, info, info.place_degrees) for s, info in infos if s is not None]
    known = [(s, info, place) for s, info, place in placed if place is not None]
    if not known:
        return []
    sigmas = [info.place_sigma_metres or GPS_SIGMA_METRES for _, info, _ in known]
    places = np.array([place for _, _, place in known])
    write_gps(staging / GPS, [stamp for stamp, _, _ in known], places, sigmas)
    return [f"{GPS:<12} {len(known)} readings of {len(files)} photos, for --gps"]


def _of_bag(path: Path, files: Sequence[FrameFile], staging: Path) -> list[str]:
    """Write what a bag has besides pictures; return a line for each, also for what is not there."""
    topics = (f.part.topic for f in files if f.path == path and isinstance(f.part, BagFrame))
    parts: list[tuple[str, Callable[[], str]]] = [
        (LENS, lambda: _write_lens(staging / LENS, camera_info(path, next(topics, "")))),
        (ODOMETRY, lambda: _write_odometry(staging / ODOMETRY, path)),
        (GPS, lambda: _write_gps(staging / GPS, path)),
        (COMPASS, lambda: _write_compass(staging / COMPASS, path)),
    ]
    lines = []
    for name, write in parts:
        if (staging / name).exists():
            continue
        try:
            lines.append(f"{name:<12} {write()}")
        except SlamcliError as error:
            lines.append(f"no {name}: {error}")
    return lines


def _write_lens(path: Path, document: dict[str, Any]) -> str:
    write_text(path, yaml.safe_dump(document, sort_keys=False))
    size = f"{document['image_width']}x{document['image_height']}"
    return f"the lens, for slam calibrate --intrinsics; {size} pixels"


def _write_odometry(path: Path, bag: Path) -> str:
    readings = read_odometry(bag)
    write_odometry(path, [one.stamp for one in readings], [one.pose for one in readings])
    return f"{len(readings)} readings, for --odometry"


def _write_gps(path: Path, bag: Path) -> str:
    readings = read_gps(bag)
    places = np.array([(one.latitude_degrees, one.longitude_degrees) for one in readings])
    sigmas = [one.sigma_metres for one in readings]
    write_gps(path, [one.stamp for one in readings], places, sigmas)
    lever = antenna_metres(bag)
    where = "" if lever is None else f" --lever-arm {lever[0]:.9g},{lever[1]:.9g}"
    return f"{len(readings)} readings, for --gps{where}"


def _write_compass(path: Path, bag: Path) -> str:
    readings = read_compass(bag)
    headings = np.array([one.heading_radians for one in readings])
    sigmas = [one.sigma_radians for one in readings]
    write_compass(path, [one.stamp for one in readings], headings, sigmas)
    return f"{len(readings)} readings, for --compass"
