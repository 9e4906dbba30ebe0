"""Frames of a camera that looks ahead, without a calibration: its mounting found by the frames."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import choose_max_range
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.mounting import compose_robot_from_image, image_from_robot_homography
from slamcli.core.errors import InputError
from slamcli.io.frames import of_camera
from slamcli.mapping.mapper import Mapper
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import Drive
from slamcli.survey import SurveyFeatures
from slamcli.survey.oblique import FloorMotion, ObliqueCamera, estimate_camera, floor_motion

# Every frame's floor is compared with that of the next ones; at most so many pairs are needed.
_NEIGHBOURS, _MAX_MOTIONS = 2, 24
# A fixed camera leaves at most this many times the error of a free homography for each pair.
_EXPLAINED_FACTOR, _EXPLAINED_PIXELS = 1.5, 0.3


def find_camera(
    features: Sequence[SurveyFeatures | None], session: Session, *, apart: bool
) -> ObliqueCamera | None:
    """Return the fixed camera that explains the floor's motions, determined or not.

    None when there is none, so that the frames may be a survey.

    Parameters
    ----------
    features : sequence of SurveyFeatures or None
        Of the frames, in order; None for one that cannot be used.
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
    found = session.stage("finding the floor", _motion, known)
    motions = [one for one in found if one is not None and (one.apart or not apart)]
    if len(motions) > _MAX_MOTIONS:
        chosen = np.linspace(0, len(motions) - 1, _MAX_MOTIONS).round().astype(int).tolist()
        motions = [motions[number] for number in chosen]
    camera = estimate_camera(motions, known[0][0].size)
    if apart or not motions:
        return camera if motions else None
    free = float(np.median([one.residual_pixels for one in motions]))
    explained = camera.median_pixels <= _EXPLAINED_FACTOR * free + _EXPLAINED_PIXELS
    return camera if explained and not camera.steep else None


def _motion(pair: tuple[SurveyFeatures, SurveyFeatures]) -> FloorMotion | None:
    return floor_motion(*pair)


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
            f"{camera.reason}; calibrate it (slam calibrate), or give --mount free if they are "
            "from above"
        )
    options = replace(drive.options, self_calibrate=True)
    calibration = _calibration(camera, size, options.height_metres)
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


def _calibration(
    camera: ObliqueCamera, size: tuple[int, int], height_metres: float | None
) -> Calibration:
    column, row = image_centre(size)
    focal, height = camera.focal_pixels, height_metres or 1.0
    matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
    mounting = (height, camera.pitch_radians, camera.roll_radians)
    image_from_robot = image_from_robot_homography(matrix, *mounting)
    return Calibration(
        camera_matrix=matrix,
        distortion=np.array([camera.k1, 0.0, 0.0, 0.0, 0.0]),
        distortion_model="plumb_bob",
        image_size=size,
        robot_from_image=compose_robot_from_image(matrix, *mounting),
        height_metres=height,
        pitch_radians=camera.pitch_radians,
        roll_radians=camera.roll_radians,
        max_range_metres=choose_max_range(matrix, image_from_robot, size),
        focal_sigma_pixels=camera.focal_sigma * focal,
        pitch_sigma_radians=camera.pitch_sigma,
        unit="m" if height_metres else "h",
    )
