"""From links and readings to arrays, and a first guess of what the senses are off by."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.geometry import Pose2, compose_poses, pose_array
from slamcli.core.records import Link
from slamcli.stages.posegraph.factors import HeadingReading, PositionReading, SensorOffsets
from slamcli.stages.posegraph.measurements import Headings, Motions, Places
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.state import ANCHOR_SIGMA, LOOSE_SIGMA, GraphState, SensorPrior

_REWEIGHTINGS = 30
# Metres within which a place counts in full as the first guess is made.
_NEAR_METRES = 0.1
# A robot's antenna is on the robot (m).
_LEVER_SIGMA = 1.0


def build(
    frames: Sequence[int],
    links: Sequence[Link],
    headings: Sequence[HeadingReading],
    places: Sequence[PositionReading],
    *,
    lever_arm_metres: tuple[float, float] | None,
    held: Collection[int] = (),
    prior: SensorOffsets | None = None,
) -> Problem:
    """Return the problem over frames, in the order of their poses; the first one is held, if none.

    Parameters
    ----------
    lever_arm_metres : (float, float) or None
        Of the GPS antenna, where it is known.
    prior : SensorOffsets or None
        What earlier readings told of the senses; of the antenna that is taken for certain.
    """
    pose_of = {frame: place for place, frame in enumerate(frames)}
    return Problem(
        Motions(
            _numbers([pose_of[link.a] for link in links]),
            _numbers([pose_of[link.b] for link in links]),
            pose_array([link.a_from_b for link in links]),
            _whitenings(np.array([link.covariance for link in links]).reshape(-1, 3, 3)),
        ),
        Headings(
            _numbers([pose_of[heading.frame] for heading in headings]),
            np.array([heading.frame_from_robot.theta for heading in headings]),
            np.array([heading.heading_radians for heading in headings]),
            np.array([heading.sigma_radians for heading in headings]),
        ),
        Places(
            _numbers([pose_of[place.frame] for place in places]),
            pose_array([place.frame_from_robot for place in places]),
            np.array([(p.east_metres, p.north_metres) for p in places]).reshape(-1, 2),
            np.array([place.sigma_metres for place in places]),
        ),
        np.concatenate(
            [
                np.ones(len(links)),
                np.array([heading.share for heading in headings]),
                np.array([place.share for place in places]),
            ]
        ),
        _numbers(sorted(pose_of[frame] for frame in held) or [0]),
        _nothing_told(lever_arm_metres) if prior is None else _told(prior),
    )


def first_state(problem: Problem, poses: Float64Array) -> GraphState:
    """Return first poses with the compass's offset and the datum that most readings agree on."""
    senses = problem.prior.senses.copy()
    if problem.prior.told:
        return GraphState(poses, senses)
    if len(problem.headings):
        told = poses[problem.headings.pose, 2] + problem.headings.turn
        senses[0] = _middle_angle(problem.headings.heading - told)
    if len(problem.places):
        antenna = compose_poses(problem.places.motion, np.append(senses[4:], 0.0))
        in_map = compose_poses(poses[problem.places.pose], antenna)[:, :2]
        senses[1:4] = _align(in_map, problem.places.east_north)
    return GraphState(poses, senses)


def _nothing_told(lever_arm_metres: tuple[float, float] | None) -> SensorPrior:
    lever = _LEVER_SIGMA if lever_arm_metres is None else ANCHOR_SIGMA
    senses = np.zeros(6)
    senses[4:] = lever_arm_metres or (0.0, 0.0)
    return SensorPrior(senses, np.diag(1.0 / np.array([LOOSE_SIGMA] * 4 + [lever] * 2)), told=False)


def _told(offsets: SensorOffsets) -> SensorPrior:
    datum = offsets.east_north_from_map
    back = Pose2(0.0, 0.0, -datum.theta).matrix
    covariance = ANCHOR_SIGMA**2 * np.eye(6)
    covariance[0, 0] = offsets.compass_offset_sigma_radians**2
    covariance[1:4, 1:4] = back @ offsets.east_north_covariance @ back.T
    senses = (offsets.compass_offset_radians, datum.x, datum.y, datum.theta)
    return SensorPrior(
        np.array([*senses, *offsets.lever_arm_metres]), _whitenings(covariance[None])[0], told=True
    )


def _numbers(values: list[int]) -> Int64Array:
    return np.array(values, dtype=np.int64)


def _whitenings(covariances: Float64Array) -> Float64Array:
    """Return (M, 3, 3) factors that turn errors of such covariances to ones of unit covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)), dtype=np.float64)


def _middle_angle(angles: Float64Array) -> float:
    """Return the median of angles, cut open opposite to their mean."""
    mean = float(np.angle(np.mean(np.exp(1j * angles))))
    around = (angles - mean + np.pi) % (2.0 * np.pi) - np.pi
    return mean + float(np.median(around))


def _align(points: Float64Array, targets: Float64Array) -> Float64Array:
    """Return the rigid motion (3,) that brings points to most of their targets.

    Least sum of distances, by iteratively reweighted least squares, each a Procrustes problem of
    complex numbers.
    """
    here, there = points @ (1.0, 1j), targets @ (1.0, 1j)
    weights = np.ones(len(here))
    motion = np.zeros(3)
    for _ in range(_REWEIGHTINGS):
        weights /= weights.sum()
        centre, target = weights @ here, weights @ there
        turn = np.angle(np.sum(weights * np.conj(here - centre) * (there - target)))
        shift = target - np.exp(1j * turn) * centre
        motion = np.array([shift.real, shift.imag, turn])
        misses = np.abs(np.exp(1j * turn) * here + shift - there)
        weights = 1.0 / np.maximum(misses, _NEAR_METRES)
    return motion
