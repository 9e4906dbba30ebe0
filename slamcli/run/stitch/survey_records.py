"""A survey's result as the records of a drive: estimates and links, by the camera's calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.mounting import rocked
from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import Link, PoseEstimate
from slamcli.io.frames import FrameFile
from slamcli.run.stitch.describing import Described
from slamcli.run.stitch.lost_in_survey import lost_reason
from slamcli.survey import Survey, SurveyMap
from slamcli.survey.pairs import Pair
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL
from slamcli.survey.uncertainty import covariances


def records(
    found: Survey,
    files: Sequence[FrameFile],
    described: Sequence[Described],
    calibration: Calibration,
) -> tuple[list[PoseEstimate], list[Link]]:
    """Return an estimate for every file that was reached, and the links between them."""
    estimates: dict[int, PoseEstimate] = {}
    links: list[Link] = []
    for fragment, one in enumerate(found.maps):
        placed = _placed(one, fragment, files, calibration)
        links += [_link(pair, placed, calibration, one) for pair in one.pairs]
        estimates |= placed
    for number, one_described in enumerate(described):
        if number not in estimates:
            file = files[number]
            reason = one_described.reason or lost_reason(
                number, found, files, one_described.features
            )
            estimates[number] = PoseEstimate(
                file.index, file.name, file.stamp, None, "lost", reason
            )
    return [estimates[number] for number in sorted(estimates)], links


def _placed(
    one: SurveyMap, fragment: int, files: Sequence[FrameFile], calibration: Calibration
) -> dict[int, PoseEstimate]:
    focal = float(calibration.camera_matrix[0, 0])
    spread = covariances(one.bundle, range(len(one.frames)), (0, 1, 2))
    found = {}
    for state, frame, in_map in zip(one.bundle.states, one.frames, spread, strict=True):
        file, pose = files[frame], Pose2(*state[:3].tolist())
        own = [pair for pair in one.pairs if frame in (pair.a, pair.b)]
        turn = np.eye(3)
        turn[:2, :2] = pose.matrix[:2, :2]
        found[frame] = PoseEstimate(
            file.index,
            file.name,
            file.stamp,
            pose,
            "tracked",
            fragment=fragment,
            covariance=turn.T @ in_map @ turn,
            inliers=max(pair.inliers for pair in own),
            score=min(1.0, max(pair.correlation for pair in own)),
            rocking=Rocking(
                float(state[PITCH]),
                float(state[ROLL]),
                focal * (math.exp(float(state[LOG_SCALE])) - 1.0),
            ),
        )
    return found


def _link(
    pair: Pair, placed: dict[int, PoseEstimate], calibration: Calibration, one: SurveyMap
) -> Link:
    """Return the motion that a pair measured, on the floor, by the tilt and height of both."""
    first, second = (_undistorted_centre(placed[n], calibration) for n in (pair.a, pair.b))
    plane = first @ pair.a_from_b @ invert(second)
    plane = plane / plane[2, 2]
    there = plane[:2, 2]
    turn = plane[:2, :2] - np.outer(there, plane[2, :2])
    heading = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    noise = one.bundle.noise_pixels**2 / max(1, len(pair.pixels_a))
    base = float(np.var(pair.pixels_a, axis=0).sum()) + 1.0
    return Link(
        placed[pair.a].index,
        placed[pair.b].index,
        Pose2(float(there[0]), float(there[1]), heading),
        np.diag([noise, noise, noise / base]),
        pair.inliers,
        min(1.0, pair.correlation),
        "step" if pair.b == pair.a + 1 else "loop",
    )


def _undistorted_centre(estimate: PoseEstimate, calibration: Calibration) -> Float64Array:
    """Return (3, 3): pixels from the picture's middle to the floor below a frame."""
    assert estimate.rocking is not None
    middle = np.eye(3)
    middle[:2, 2] = calibration.camera_matrix[:2, 2]
    return rocked(calibration, estimate.rocking).robot_from_image @ middle
