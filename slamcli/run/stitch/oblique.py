"""Frames of a camera that looks ahead, without a calibration: its mounting found by the frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TypeVar

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.errors import FrameError, InputError
from slamcli.io.frames import FrameFile, of_camera, read_frame
from slamcli.mapping.mapper import Mapper
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import Drive
from slamcli.run.stitch.focal_length import noted_focal_pixels
from slamcli.survey import SurveyFeatures
from slamcli.survey.ideal_picture import focal_pixels
from slamcli.survey.oblique import FloorMotion, estimate_camera, floor_motion
from slamcli.survey.oblique_by_pixels import MAX_PICTURES, camera_by_pixels
from slamcli.survey.oblique_camera import KNOWN_FOCAL_SIGMA, ObliqueCamera

# Frames' floors are compared with those of the next ones, so many pairs; at most so many motions of
# the floor are needed.
_NEIGHBOURS, _MAX_COMPARED, _MAX_MOTIONS = 2, 40, 24
# The camera is sought by the pixels of at most so many runs of consecutive pictures.
_RUNS = 3
# A fixed camera leaves at most this many times the error of a free homography for each pair.
_EXPLAINED_FACTOR, _EXPLAINED_PIXELS = 1.5, 0.3
Item = TypeVar("Item")


def find_camera(
    features: Sequence[SurveyFeatures | None],
    drive: Drive,
    session: Session,
    *,
    apart: bool,
) -> ObliqueCamera | None:
    """Return the fixed camera that explains the floor's motions, determined or not.

    None when there is none, so that the frames may be a survey.

    Parameters
    ----------
    features : sequence of SurveyFeatures or None
        Of the frames, in order; None for one that cannot be used.
    drive : Drive
        What is known of its lens, or its files note of the focal length, is used.
    apart : bool
        Whether the frames also show what stands behind the floor: then only motions of lower rows
        than another are the floor's.
    """
    pairs = [
        (first, features[number + step])
        for step in range(1, _NEIGHBOURS + 1)
        for number, first in enumerate(features[: len(features) - step])
    ]
    known = [(a, b) for a, b in pairs if a is not None and b is not None and a.size == b.size]
    if not known:
        return None
    found = session.stage("finding the floor", _motion, _spread(known, _MAX_COMPARED))
    motions = [one for one in found if one is not None and (one.apart or not apart)]
    motions = _spread(motions, _MAX_MOTIONS)
    size = known[0][0].size
    if drive.intrinsics is None:
        camera = estimate_camera(motions, size, noted_focal_pixels(drive.inputs.files, size))
    else:
        focal = focal_pixels(drive.intrinsics)
        camera = estimate_camera(motions, size, focal, KNOWN_FOCAL_SIGMA)
    if apart or not motions:
        return camera if motions else None
    free = float(np.median([one.residual_pixels for one in motions]))
    explained = camera.median_pixels <= _EXPLAINED_FACTOR * free + _EXPLAINED_PIXELS
    return camera if explained and not camera.steep else None


def find_camera_by_pixels(files: Sequence[FrameFile], session: Session) -> ObliqueCamera | None:
    """Return the fixed camera that some runs of consecutive pictures show, determined or not.

    For floors of lines and edges, whose features have no motion in common. None when there is none.

    Parameters
    ----------
    files : sequence of FrameFile
        Those whose pictures have another size than most are left out.
    """
    found = None
    starts = np.linspace(0, max(0, len(files) - MAX_PICTURES), _RUNS).round().astype(int)
    for start in np.unique(starts).tolist():
        pictures = _pictures(files[start : start + MAX_PICTURES])
        if len(pictures) < 2:
            continue
        camera = camera_by_pixels(pictures, partial(session.stage, "finding the floor"))
        if camera is not None and not camera.reason:
            return camera
        found = found or camera
    return found


def _pictures(files: Sequence[FrameFile]) -> list[UInt8Array]:
    """Return the pictures that can be read."""
    found = []
    for file in files:
        try:
            found.append(read_frame(file, gray=True).image)
        except FrameError:
            continue
    return found


def _spread(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most so many of the items, evenly spread."""
    chosen = np.unique(np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int))
    return [items[number] for number in chosen.tolist()]


def _motion(pair: tuple[SurveyFeatures, SurveyFeatures]) -> FloorMotion | None:
    return floor_motion(*pair)


def _with_lens(calibration: Calibration, lens: Intrinsics) -> Calibration:
    """Return a calibration with a known lens in place of the one found."""
    mounting = calibration.height_metres, calibration.pitch_radians, calibration.roll_radians
    return replace(
        calibration,
        camera_matrix=lens.camera_matrix,
        distortion=lens.distortion,
        distortion_model=lens.distortion_model,
        robot_from_image=compose_robot_from_image(lens.camera_matrix, *mounting),
    )


def with_camera(drive: Drive, camera: ObliqueCamera, size: tuple[int, int]) -> Drive:
    """Return the drive with a camera found by its frames, which self-calibration refines.

    Raises
    ------
    InputError
        When the frames do not determine the camera.
    """
    if camera.reason:
        raise InputError(
            "without a calibration these frames cannot be mapped: the camera looks ahead, and "
            f"{camera.reason}; calibrate it (slam calibrate), or give --mount hand if they are "
            "from above"
        )
    options = replace(drive.options, self_calibrate="always")
    calibration = camera.calibration(size, options.height_metres)
    if drive.intrinsics is not None:
        calibration = _with_lens(calibration, drive.intrinsics)
    mapper = Mapper(calibration, drive.mapper.options, options.telemetry)
    note = (
        f"no calibration: a camera that looks ahead, by the frames: focal length "
        f"{camera.focal_pixels:.0f} px, pitch {math.degrees(camera.pitch_radians):.1f}°"
    )
    if calibration.unit == "h":
        note += "; lengths are in heights of the camera (h), as --height is not given"
    inputs = drive.inputs
    inputs = replace(
        inputs, files=of_camera(inputs.files, size), calibration=calibration, note=note
    )
    return replace(drive, inputs=inputs, options=options, mapper=mapper)
