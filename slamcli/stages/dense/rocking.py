"""A camera that rocks: how its views shift the floor, and whether residuals suggest rocking."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.camera.calibration import CACHED_CALIBRATIONS, Calibration
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import apply_homography
from slamcli.core.records import PyramidLevel, SampledLevel
from slamcli.stages.dense.covariance import FitState, NormalEquations, blocks

# A robot that rocks by a radian bounces by this many times its camera's height
# [guarded by benchmarks/robustness.py: rocking].
_HEIGHT_SHARE_PER_RADIAN = 3.0
# Rocking is suspected where it would make the weighted squares fall by this, and move a point at
# the far end by this many pixels. Over plain lines a steady camera reaches either now and then
# [guarded by tests/registration/test_dense.py: pairs that rock by 0.1 degrees, and steady ones].
_MIN_GAIN = 20.0
_MIN_CHANGE_PIXELS = 0.25
# Nor where only some blocks of the view show it: the edges of lines, resampled, leave residuals
# that agree within a block and not between them. The same test by the variance between blocks has
# six degrees of freedom: one steady frame in a hundred exceeds this
# [guarded by tests/registration/test_dense.py; benchmarks/streaming.py: course].
_MIN_GAIN_BETWEEN_BLOCKS = 16.8
# The squared deviations of pitch, roll and height of two frames that rock as expected, in sigmas,
# add up to about six; what both frames have in common hardly shows, and stays at nothing.
_MAX_SQUARED_SIGMAS = 6.0
_MAX_TEST_POINTS = 2000
# Of a steady camera: the motion, gain and offset.
_STEADY_UNKNOWNS = 5


def mounting_sigmas(calibration: Calibration, tilt_sigma_radians: float) -> Float64Array:
    """Return (3,) sigmas of a frame's pitch, roll and height; (0,) for a camera without them."""
    if not math.isfinite(calibration.height_metres) or tilt_sigma_radians <= 0.0:
        return np.zeros(0)
    height = _HEIGHT_SHARE_PER_RADIAN * tilt_sigma_radians * calibration.height_metres
    return np.array([tilt_sigma_radians, tilt_sigma_radians, height])


def shown_from_floor(calibration: Calibration, mounting: Float64Array) -> Float64Array:
    """Return (3, 3), metres to metres: where a view shows the floor of a tilted frame.

    `mounting` (3,) is what its pitch, roll and height differ from the calibration's by.
    """
    if not np.any(mounting):
        return np.eye(3)
    tilted = image_from_robot_homography(
        calibration.camera_matrix,
        calibration.height_metres + float(mounting[2]),
        calibration.pitch_radians + float(mounting[0]),
        calibration.roll_radians + float(mounting[1]),
        calibration.ahead_radians,
    )
    shown = calibration.robot_from_image @ tilted
    return np.asarray(shown / shown[2, 2])


def shown_from_floor_by_each(calibration: Calibration, sigmas: Float64Array) -> Float64Array:
    """Return (K, 3, 3): `shown_from_floor` with one sigma of each in turn."""
    return _shown_by_each(calibration, tuple(sigmas.tolist()))


@lru_cache(maxsize=CACHED_CALIBRATIONS)
def _shown_by_each(calibration: Calibration, sigmas: tuple[float, ...]) -> Float64Array:
    shown = np.array(
        [shown_from_floor(calibration, row) for row in np.diag(sigmas)], dtype=np.float64
    ).reshape(-1, 3, 3)
    shown.setflags(write=False)
    return shown


def shifts(shown_from_floor_by_each: Float64Array, points: Float64Array) -> Float64Array:
    """Return (K, 2, N): metres by which (N, 2) points are shown elsewhere, for one sigma of each.

    The points run along the last axis, as in `slopes`: numpy is slow along axes as short as two.
    """
    shifts = np.empty((len(shown_from_floor_by_each), 2, len(points)))
    for shift, homography in zip(shifts, shown_from_floor_by_each, strict=True):
        np.subtract(apply_homography(homography, points).T, points.T, out=shift)
    return shifts


def slopes(
    gradients_a: Float64Array,
    gradients_b: Float64Array,
    shifts_a: Float64Array,
    shifts_b: Float64Array,
) -> Float64Array:
    """Return (2 K, N): how residuals change with either frame's rocking, a's before b's.

    Parameters
    ----------
    gradients_a, gradients_b : (2, N) float64
        Of view a's picture, in a's axes and in b's.
    shifts_a, shifts_b : (K, 2, N) float64
        From `shifts`, each in its own frame's axes.
    """
    slopes_a = shifts_a[:, 0] * gradients_a[0] + shifts_a[:, 1] * gradients_a[1]
    slopes_b = shifts_b[:, 0] * gradients_b[0] + shifts_b[:, 1] * gradients_b[1]
    return np.concatenate([-slopes_a, slopes_b])


def slopes_along_edges(
    solved: NormalEquations, calibration: Calibration, sigmas: Float64Array
) -> Float64Array | None:
    """Return (K, N): the slopes, if the gradients were turned by a right angle.

    None for a steady camera, whose (K,) sigmas are empty.
    """
    if not len(sigmas):
        return None
    right, up = -solved.slopes[1], solved.slopes[0]
    turn = up * solved.points[:, 0] - right * solved.points[:, 1]
    light = np.zeros((_STEADY_UNKNOWNS - 3, len(turn)))
    steady = np.concatenate([right[None], up[None], turn[None], light])
    rocking = _slopes_of_rocking(solved, steady, solved.points, calibration, sigmas)
    return np.concatenate([steady, rocking])


def exceeds_sigmas(state: FitState, sigmas: Float64Array) -> bool:
    """Return whether the rocking that was estimated is more than its (K,) sigmas let expect."""
    deviation = np.concatenate([state.mounting_a, state.mounting_b])
    return float(np.sum((deviation / np.tile(sigmas, 2)) ** 2)) > _MAX_SQUARED_SIGMAS


def explains_residuals(
    b: PyramidLevel | SampledLevel,
    solved: NormalEquations,
    calibration: Calibration,
    tilt_sigma_radians: float,
) -> bool:
    """Return whether rocking would explain much of a steady camera's residuals.

    A Gauss-Newton step with either frame's tilt and height beside the motion gives by how much the
    squares would fall (a score test: Rao, Proc. Cambridge Phil. Soc. 44, 1948) and the motion
    change.

    Parameters
    ----------
    b : PyramidLevel or SampledLevel
    solved : NormalEquations
        Of a steady camera's refinement on that level.
    calibration : Calibration
    tilt_sigma_radians : float
    """
    sigmas = mounting_sigmas(calibration, tilt_sigma_radians)
    if not len(sigmas):
        return False
    sampled = slice(None, None, -(-len(solved.points) // _MAX_TEST_POINTS))
    points_b = solved.points[sampled]
    residual, weight = solved.residual[sampled], solved.weight[sampled]
    steady = solved.slopes[:, sampled]
    rocking = _slopes_of_rocking(solved, steady, points_b, calibration, sigmas)
    every = np.concatenate([steady, rocking])
    # The sample represents all points.
    share = len(solved.points) / len(points_b)
    count = len(steady)
    information = share * (every * weight) @ every.T
    information[:count, :count] += solved.prior
    information[count:, count:] += np.eye(2 * len(sigmas))
    gradient = share * every @ (weight * residual)
    try:
        step = np.linalg.solve(information, gradient)
        alone = np.linalg.solve(information[:count, :count], gradient[:count])
    except np.linalg.LinAlgError:
        return False
    gain = float(gradient @ step - gradient[:count] @ alone)
    change = step[:3] - alone[:3]
    moved = math.hypot(change[0], change[1]) + abs(change[2]) * float(np.abs(points_b).max())
    if not (gain > _MIN_GAIN and moved > _MIN_CHANGE_PIXELS * b.metres_per_pixel):
        return False
    apart = information[count:, :count] @ np.linalg.pinv(information[:count, :count])
    slopes_apart = (rocking - apart @ steady) * (weight * residual)
    return _gain_between_blocks(slopes_apart, blocks(b, points_b)) > _MIN_GAIN_BETWEEN_BLOCKS


def _gain_between_blocks(scores: Float64Array, block: Int64Array) -> float:
    """Return how far sums of (K, N) scores are from zero, by their variance between blocks (N,)."""
    sums = np.array([np.bincount(block, weights=score) for score in scores])
    total = sums.sum(axis=1)
    return float(total @ np.linalg.pinv(sums @ sums.T) @ total)


def _slopes_of_rocking(
    solved: NormalEquations,
    steady: Float64Array,
    points_b: Float64Array,
    calibration: Calibration,
    sigmas: Float64Array,
) -> Float64Array:
    """Return (2 K, N): how residuals whose (5, N) slopes are `steady` change with rocking."""
    gradients_b = -steady[:2]
    gradients_a = solved.state.a_from_b.matrix[:2, :2] @ gradients_b
    shown_from_floor = shown_from_floor_by_each(calibration, sigmas)
    shifts_a = shifts(shown_from_floor, solved.state.a_from_b.apply(points_b))
    shifts_b = shifts(shown_from_floor, points_b)
    return slopes(gradients_a, gradients_b, shifts_a, shifts_b)
