"""Assembly of the least-squares problem from links and readings, and its initial state."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from slamcli.core.arrays import Complex128Array, Float64Array, Int64Array
from slamcli.core.geometry import Pose2, compose_poses, pose_array
from slamcli.core.records import Link
from slamcli.stages.posegraph.factors import SensorOffsets, SensorReadings
from slamcli.stages.posegraph.measurements import Headings, Motions, Positions
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.state import ANCHOR_SIGMA, LOOSE_SIGMA, GraphState, SensorPrior

# Iterations of the robust alignment, linear in convergence: far more than it needs.
_REWEIGHTINGS = 30
# Bounds the weight of a position in it. [guarded by tests/mapping/backend/test_sensors.py]
_MIN_DISTANCE_METRES = 0.1
# Readings whose pairs with others are tried for a first alignment, and by how much nearer that must
# bring half of them to be preferred [guarded by tests/mapping/backend/test_sensors.py].
_MAX_PAIRS = 50
_MUCH_NEARER = 0.5
# Prior sigma of an unknown lever arm: an antenna is on the robot.
_LEVER_ARM_SIGMA_METRES = 1.0


def build(
    frames: Sequence[int],
    links: Sequence[Link],
    readings: SensorReadings,
    fixed: Collection[int] = (),
) -> Problem:
    """Return the problem over frames, in the order of their poses; without `fixed` the first is."""
    index_of = {frame: index for index, frame in enumerate(frames)}
    headings, positions = readings.headings, readings.positions
    return Problem(
        Motions(
            _indices([index_of[link.a] for link in links]),
            _indices([index_of[link.b] for link in links]),
            pose_array([link.a_from_b for link in links]),
            _whitenings(np.array([link.covariance for link in links]).reshape(-1, 3, 3)),
        ),
        Headings(
            _indices([index_of[heading.frame] for heading in headings]),
            np.array([heading.frame_from_robot.theta for heading in headings]),
            np.array([heading.heading_radians for heading in headings]),
            np.array([heading.sigma_radians for heading in headings]),
        ),
        Positions(
            _indices([index_of[position.frame] for position in positions]),
            pose_array([position.frame_from_robot for position in positions]),
            np.array([(p.east_metres, p.north_metres) for p in positions]).reshape(-1, 2),
            np.array([position.sigma_metres for position in positions]),
        ),
        np.concatenate(
            [
                np.ones(len(links)),
                np.array([heading.share for heading in headings]),
                np.array([position.share for position in positions]),
            ]
        ),
        _indices(sorted(index_of[frame] for frame in fixed) or [0]),
        _loose_prior(readings.lever_arm_metres)
        if readings.prior is None
        else _prior(readings.prior),
    )


def initial_state(problem: Problem, poses: Float64Array) -> GraphState:
    """Return initial poses, with the compass offset and datum that most readings agree on."""
    offsets = problem.prior.offsets.copy()
    if problem.prior.is_measured:
        return GraphState(poses, offsets)
    if len(problem.headings):
        in_map = poses[problem.headings.pose, 2] + problem.headings.turn
        offsets[0] = _median_angle(problem.headings.heading - in_map)
    if len(problem.positions):
        antenna = compose_poses(problem.positions.motion, np.append(offsets[4:], 0.0))
        in_map = compose_poses(poses[problem.positions.pose], antenna)[:, :2]
        offsets[1:4] = _align(in_map, problem.positions.east_north)
    return GraphState(poses, offsets)


def _loose_prior(lever_arm_metres: tuple[float, float] | None) -> SensorPrior:
    lever = _LEVER_ARM_SIGMA_METRES if lever_arm_metres is None else ANCHOR_SIGMA
    offsets = np.zeros(6)
    offsets[4:] = lever_arm_metres or (0.0, 0.0)
    sigmas = np.array([LOOSE_SIGMA] * 4 + [lever] * 2)
    return SensorPrior(offsets, np.diag(1.0 / sigmas), is_measured=False)


def _prior(known: SensorOffsets) -> SensorPrior:
    datum = known.east_north_from_map
    back = Pose2(0.0, 0.0, -datum.theta).matrix
    covariance = ANCHOR_SIGMA**2 * np.eye(6)
    covariance[0, 0] = known.compass_offset_sigma_radians**2
    covariance[1:4, 1:4] = back @ known.east_north_covariance @ back.T
    offsets = (known.compass_offset_radians, datum.x, datum.y, datum.theta, *known.lever_arm_metres)
    return SensorPrior(np.array(offsets), _whitenings(covariance[None])[0], is_measured=True)


def _indices(values: list[int]) -> Int64Array:
    return np.array(values, dtype=np.int64)


def _whitenings(covariances: Float64Array) -> Float64Array:
    """Return (M, 3, 3) factors that give errors of these covariances unit covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)), dtype=np.float64)


def _median_angle(angles: Float64Array) -> float:
    """Return the median of angles, unwrapped about their mean."""
    mean = float(np.angle(np.mean(np.exp(1j * angles))))
    unwrapped = (angles - mean + np.pi) % (2.0 * np.pi) - np.pi
    return mean + float(np.median(unwrapped))


def _align(points: Float64Array, targets: Float64Array) -> Float64Array:
    """Return the rigid motion (3,) of points to their targets that most of them agree on.

    That of least summed distance, from the motion of all points. Few outliers a kilometre away can
    turn it round; then that of two points which brings half of all far nearer (least trimmed sum).
    """
    here, there = (np.asarray(a @ (1.0, 1j), np.complex128) for a in (points, targets))
    least = _least_sum(here, there)
    pair = _best_of_pairs(here, there)
    far = _trimmed_sum(_distances(here, there, least))
    near = _trimmed_sum(_distances(here, there, pair))
    return pair if near < _MUCH_NEARER * far - len(here) * _MIN_DISTANCE_METRES else least


def _least_sum(here: Complex128Array, there: Complex128Array) -> Float64Array:
    """Return the rigid motion by iteratively reweighted least squares.

    Each is a Procrustes problem of complex numbers.
    """
    weights = np.ones(len(here))
    motion = np.zeros(3)
    for _ in range(_REWEIGHTINGS):
        weights /= weights.sum()
        centre, target = weights @ here, weights @ there
        turn = np.angle(np.sum(weights * np.conj(here - centre) * (there - target)))
        shift = target - np.exp(1j * turn) * centre
        motion = np.array([shift.real, shift.imag, turn])
        weights = 1.0 / np.maximum(_distances(here, there, motion), _MIN_DISTANCE_METRES)
    return motion


def _best_of_pairs(here: Complex128Array, there: Complex128Array) -> Float64Array:
    """Return the rigid motion of two points, far apart in time, with the least trimmed sum."""
    count = len(here)
    best, least = np.zeros(3), np.inf
    for first in np.unique(np.linspace(0, count - 1, min(count, _MAX_PAIRS)).astype(np.int64)):
        for second in ((first + count // 2) % count, (first + count // 3) % count):
            turn = np.angle(np.conj(here[second] - here[first]) * (there[second] - there[first]))
            shift = there[first] - np.exp(1j * turn) * here[first]
            motion = np.array([shift.real, shift.imag, turn])
            trimmed = _trimmed_sum(_distances(here, there, motion))
            if trimmed < least:
                best, least = motion, trimmed
    return best


def _trimmed_sum(distances: Float64Array) -> float:
    """Return the sum of the smaller half."""
    kept = len(distances) // 2 + 1
    return float(np.partition(distances, kept - 1)[:kept].sum())


def _distances(here: Complex128Array, there: Complex128Array, motion: Float64Array) -> Float64Array:
    """Return (N,) distances of points from their targets after a rigid motion (3,)."""
    moved = np.exp(1j * motion[2]) * here + complex(motion[0], motion[1])
    return np.asarray(np.abs(moved - there), dtype=np.float64)
