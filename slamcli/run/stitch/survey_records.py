"""A survey's result as the records of a drive: estimates and links, by the camera's calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
from slamcli.survey.mounted import mounted, pose_by_state
from slamcli.survey.pairs import Pair
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL, STATES
from slamcli.survey.uncertainty import covariances


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A frame in its map.

    Attributes
    ----------
    pose : Pose2
        Units of the map: pixels without a calibration, else metres.
    covariance : (3, 3) float64
        In the frame's own axes.
    rocking : Rocking
    floor_from_pixels : (3, 3) float64
        From the picture's middle to the floor in the frame's own axes.
    unit : float
        Of the map, in lengths of the survey's states.
    """

    pose: Pose2
    covariance: Float64Array
    rocking: Rocking
    floor_from_pixels: Float64Array
    unit: float


def records(
    found: Survey,
    files: Sequence[FrameFile],
    described: Sequence[Described],
    calibration: Calibration,
) -> tuple[list[PoseEstimate], list[Link]]:
    """Return an estimate for every file that was reached, and the links between them."""
    estimates: dict[int, PoseEstimate] = {}
    links: list[Link] = []
    place = _placed_top_down if calibration.is_top_down else _placed_mounted
    for fragment, one in enumerate(found.maps):
        placed = dict(zip(one.frames, place(one, calibration), strict=True))
        links += [_link(pair, placed, files, one) for pair in one.pairs]
        for frame, there in placed.items():
            own = [pair for pair in one.pairs if frame in (pair.a, pair.b)]
            estimates[frame] = _estimate(files[frame], there, own, fragment)
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


def _placed_top_down(one: SurveyMap, calibration: Calibration) -> list[_Placed]:
    """Return the frames of a map without a calibration: the floor in their middles."""
    focal = float(calibration.camera_matrix[0, 0])
    middle = np.eye(3)
    middle[:2, 2] = calibration.camera_matrix[:2, 2]
    spread = covariances(one.bundle, range(len(one.frames)), (0, 1, 2))
    found = []
    for state, in_map in zip(one.bundle.states, spread, strict=True):
        pose = Pose2(*state[:3].tolist())
        rocking = Rocking(
            float(state[PITCH]),
            float(state[ROLL]),
            focal * (math.exp(float(state[LOG_SCALE])) - 1.0),
        )
        floor_from_pixels = rocked(calibration, rocking).robot_from_image @ middle
        found.append(_Placed(pose, _in_frame(in_map, pose), rocking, floor_from_pixels, 1.0))
    return found


def _placed_mounted(one: SurveyMap, calibration: Calibration) -> list[_Placed]:
    """Return the frames of a map of a calibrated camera, from the first one's robot on.

    The calibration's height is the mean of theirs.
    """
    frames = [mounted(state, calibration) for state in one.bundle.states]
    unit = calibration.height_metres / float(np.mean([frame.height for frame in frames]))
    frames = [frame.scaled(unit) for frame in frames]
    origin = frames[0].map_from_robot.inverse()
    spread = covariances(one.bundle, range(len(frames)), range(STATES))
    metres = np.diag([unit, unit, 1.0])
    found = []
    for state, frame, of_state in zip(one.bundle.states, frames, spread, strict=True):
        change = metres @ pose_by_state(state, calibration)
        in_frame = _in_frame(change @ of_state @ change.T, frame.map_from_robot)
        floor_from_pixels = frame.robot_from_pixels(calibration)
        pose, rocking = origin @ frame.map_from_robot, frame.rocking(calibration)
        found.append(_Placed(pose, in_frame, rocking, floor_from_pixels, unit))
    return found


def _in_frame(in_map: Float64Array, pose: Pose2) -> Float64Array:
    """Return the covariance of a pose, turned into its own axes."""
    turn = np.eye(3)
    turn[:2, :2] = pose.matrix[:2, :2]
    return np.asarray(turn.T @ in_map @ turn, np.float64)


def _estimate(
    file: FrameFile, placed: _Placed, pairs: Sequence[Pair], fragment: int
) -> PoseEstimate:
    return PoseEstimate(
        file.index,
        file.name,
        file.stamp,
        placed.pose,
        "tracked",
        fragment=fragment,
        covariance=placed.covariance,
        inliers=max(pair.inliers for pair in pairs),
        score=min(1.0, max(pair.correlation for pair in pairs)),
        rocking=placed.rocking,
    )


def _link(
    pair: Pair, placed: dict[int, _Placed], files: Sequence[FrameFile], one: SurveyMap
) -> Link:
    """Return the motion that a pair measured, on the floor, by the tilt and height of both."""
    first, second = placed[pair.a], placed[pair.b]
    plane = first.floor_from_pixels @ pair.a_from_b @ invert(second.floor_from_pixels)
    plane = plane / plane[2, 2]
    there = plane[:2, 2]
    turn = plane[:2, :2] - np.outer(there, plane[2, :2])
    heading = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    noise = one.bundle.noise_pixels**2 / max(1, len(pair.pixels_a))
    base = float(np.var(pair.pixels_a, axis=0).sum()) + 1.0
    length = first.unit**2 * noise
    return Link(
        files[pair.a].index,
        files[pair.b].index,
        Pose2(float(there[0]), float(there[1]), heading),
        np.diag([length, length, noise / base]),
        pair.inliers,
        min(1.0, pair.correlation),
        "step" if pair.b == pair.a + 1 else "loop",
    )
