"""A calibrated camera that is carried by hand: its tilt and height vary from frame to frame.

A robot's motion is rigid on the floor, and frames are tracked by that. Where that leaves frames
lost and some pairs of consecutive ones contradict it, all are located as a survey is, with six
degrees of freedom about the calibration.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import apply_homography, invert
from slamcli.core.robust import fit_rigid_2d
from slamcli.io.frames import FrameFile
from slamcli.run.session.session import Session
from slamcli.run.stitch.describing import describe_file
from slamcli.run.stitch.drive import Drive, LocatedDrive
from slamcli.survey.ideal_picture import (
    IdealPicture,
    camera_from_nadir,
    ideal_picture,
)
from slamcli.survey.pairs import find_pair

# So many pairs about lost frames are compared; the camera rocks when most of those that are found
# leave a rigid motion by more than this share of the picture's longer side, median
# [benchmarks/free_cameras.py: 0.3 px of 640 without rocking, 5 with 3 degrees].
_PROBES, _MIN_FOUND, _RIGID_SHARE = 5, 2, 0.003


def may_rock(drive: Drive) -> bool:
    """Return whether frames may be located so: calibrated, no sensor, no earlier map.

    With `--self-calibrate` it is the calibration that frames contradict, not the mount, unless
    that is known to vary.
    """
    options = drive.options
    return (
        drive.inputs.calibration_path is not None
        and math.isfinite(drive.inputs.calibration.height_metres)
        and options.extend is None
        and not drive.telemetry_files.any
        and options.mount != "rigid"
        and (options.self_calibrate != "always" or options.moves_freely)
    )


def rocks(located: LocatedDrive, session: Session) -> bool:
    """Return whether the frames about lost ones contradict a rigid mount."""
    files, calibration = located.drive.inputs.files, located.drive.inputs.calibration
    fragments = [
        one.fragment if one.map_from_robot is not None else -1
        for one in located.registered.estimates
    ]
    breaks = [
        number
        for number in range(len(fragments) - 1)
        if fragments[number] != fragments[number + 1] or fragments[number] < 0
    ]
    chosen = np.linspace(0, len(breaks) - 1, min(_PROBES, len(breaks))).round().astype(int)
    starts = [breaks[number] for number in chosen.tolist()]
    pairs = [(files[number], files[number + 1]) for number in starts]
    work = partial(_rigid_share, calibration, ideal_picture(calibration))
    found = [share for share in session.ordered(work, pairs) if share is not None]
    return len(found) >= _MIN_FOUND and float(np.median(found)) > _RIGID_SHARE


def _rigid_share(
    calibration: Calibration, ideal: IdealPicture, files: tuple[FrameFile, FrameFile]
) -> float | None:
    """Return by what share of the picture two frames' matches leave a rigid motion of the floor."""
    first, second = (describe_file(file, ideal).features for file in files)
    if first is None or second is None:
        return None
    pair = find_pair(0, 1, first, second)
    if pair.reason:
        return None
    nadir_from_camera = invert(camera_from_nadir(calibration))
    depths = [
        pixels @ nadir_from_camera[2, :2] + nadir_from_camera[2, 2]
        for pixels in (pair.pixels_a, pair.pixels_b)
    ]
    below = np.minimum(*depths) > 0.0
    if below.sum() < 2:
        return None
    a, b = (
        apply_homography(nadir_from_camera, pixels[below])
        for pixels in (pair.pixels_a, pair.pixels_b)
    )
    moved = fit_rigid_2d(a, b, np.minimum(*depths)[below] ** 4).apply(b)
    there = apply_homography(camera_from_nadir(calibration), moved)
    errors = np.linalg.norm(there - pair.pixels_a[below], axis=1)
    return float(np.median(errors)) / max(calibration.image_size)
