"""The rigid motion between two views, refined on their pixels.

An inverse-compositional Lucas-Kanade alignment (Baker and Matthews, IJCV 56, 2004) of a rigid
motion with gain and offset, on locally normalised gray, with Huber weights. A camera that rocks
shows the floor under a slightly other homography each time: both frames' pitch, roll and height
are estimated with the motion, held by how much they are expected to vary.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import PyramidLevel
from slamcli.core.robust import SIGMA_PER_MAD
from slamcli.stages.dense import pyramid, rocking
from slamcli.stages.dense.covariance import FitState, NormalEquations, covariance_of

_MAX_ITERATIONS = 12
# A step so small leaves next to nothing to the next one. From where a sample of the points has led
# all of them end with one step, which may be larger: what it leaves is a small share of it.
_CONVERGED_PIXELS, _FINISHING_PIXELS = 0.003, 0.03
_MIN_TEMPLATE_PIXELS = 200
_SAMPLE_POINTS = 4000
_HUBER_SIGMAS = 1.5
# On a floor of plain lines nearly every pixel fits while a line's end, which alone tells how far
# the robot went along it, does not: it must not pass for an outlier. Noise is taken to be at least
# this share of the contrast.
_MIN_NOISE_SHARE = 0.2
_MIN_LEFT_SHARE = 0.03
# Neighbouring residuals are not independent: interpolation and blur tie about this many together.
_CORRELATED_PIXELS = 24.0
_SYSTEMATIC_PIXELS = 0.02
# Rocking is suspected where it would make the weighted squares fall by so much, and move a point
# at the far end by so many pixels. Over plain lines a steady camera reaches either now and then.
_MIN_GAIN = 20.0
_MIN_CHANGE_PIXELS = 0.25
# Pitch, roll and height of two frames that rock as expected make about six; what they have in
# common hardly shows, and stays at nothing.
_MAX_STRAIN = 6.0
# A refinement that runs away from the fit that it started at, by so many pixels of the coarsest
# level, has found something else. From a search, whose rotations are steps apart, a motion that
# turns by no more than half a step may shift by such a share of what is seen.
_MAX_SHIFT_PIXELS = 6.0
_MAX_SHIFT_SHARE = 0.12
_MAX_TURN_RADIANS = math.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class PhotometricFit:
    """A refined motion.

    Attributes
    ----------
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m), theta (rad) in b's own axes.
    view_a_from_view_b : (3, 3) float64
        Metres to metres, as the views show the floor: the motion, and what each frame's tilt and
        height differ by from the calibration's.
    mounting_a, mounting_b : (K,) float64
        That difference, as `rocking.shown_from_floor` takes it; nothing for a steady camera.
    rocks : bool
        Whether the pixels ask for a camera that rocks more than was allowed for.
    """

    a_from_b: Pose2
    covariance: Float64Array
    view_a_from_view_b: Float64Array
    mounting_a: Float64Array
    mounting_b: Float64Array
    rocks: bool


@dataclass(frozen=True, slots=True, eq=False)
class MotionPrior:
    """What is known of a motion beforehand.

    Attributes
    ----------
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m), theta (rad) in b's own axes.
    """

    a_from_b: Pose2
    covariance: Float64Array


def refine(
    levels_a: Sequence[PyramidLevel],
    levels_b: Sequence[PyramidLevel],
    a_from_b: Pose2,
    calibration: Calibration,
    tilt_sigma_radians: float,
    known: MotionPrior | None = None,
    *,
    searched: bool = False,
    rocked: PhotometricFit | None = None,
    suspected_tilt_radians: float = 0.0,
) -> PhotometricFit | None:
    """Refine a motion on the pixels of two views; None when they do not determine it.

    Parameters
    ----------
    levels_a, levels_b : sequence of PyramidLevel
        From `make_levels`, of views of one resolution, from fine to coarse.
    a_from_b : Pose2
        A start within a few pixels of the truth on the coarsest of them.
    tilt_sigma_radians : float
        By how much the camera's pitch and roll vary from frame to frame.
    known : MotionPrior or None
        OptimizedComponent with what the pixels say.
    searched : bool
        Whether the start is a peak of a `search`, which may lie farther from the truth.
    rocked : PhotometricFit or None
        By other pixels or a narrower sigma: what it found of the rocking is where to start.
    suspected_tilt_radians : float
        By how much the camera may rock where it is taken to be steady: whether it does is told.
    """
    sigmas = rocking.mounting_sigmas(calibration, tilt_sigma_radians)
    state = FitState(a_from_b, np.zeros(len(sigmas)), np.zeros(len(sigmas)))
    if rocked is not None:
        state = FitState(a_from_b, rocked.mounting_a, rocked.mounting_b)
    solved: NormalEquations | None = None
    for level_a, level_b in zip(reversed(levels_a), reversed(levels_b), strict=True):
        if len(level_a.points) < _MIN_TEMPLATE_PIXELS:
            return None
        # A sample of the points brings the motion to where all of them finish it in a step or two.
        samples = [_sampled(level_a)] if len(level_a.points) > _SAMPLE_POINTS else []
        if level_a is levels_a[0]:
            samples.append(level_a)
        for sample in samples or [level_a]:
            finishing = len(samples) > 1 and sample is level_a
            least = _FINISHING_PIXELS if finishing else _CONVERGED_PIXELS
            solved = _refine_level(sample, level_b, state, calibration, sigmas, known, least)
            if solved is None:
                return None
            state = solved.state
    if solved is None or _ran_away(
        a_from_b.inverse() @ state.a_from_b, levels_a, searched=searched
    ):
        return None
    covariance = covariance_of(levels_b[0], solved)
    if covariance is None:
        return None
    covariance = covariance + _systematic(levels_a[0])
    shown_a = rocking.shown_from_floor(calibration, state.mounting_a)
    shown_b = rocking.shown_from_floor(calibration, state.mounting_b)
    return PhotometricFit(
        state.a_from_b,
        covariance,
        shown_a @ state.a_from_b.matrix @ invert(shown_b),
        state.mounting_a,
        state.mounting_b,
        _strained(state, sigmas)
        or (not len(sigmas) and _rocks(levels_b[0], solved, calibration, suspected_tilt_radians)),
    )


def _strained(state: FitState, sigmas: Float64Array) -> bool:
    """Return whether the rocking that was found is more than its sigmas let one expect."""
    found = np.concatenate([state.mounting_a, state.mounting_b])
    return float(np.sum((found / np.tile(sigmas, 2)) ** 2)) > _MAX_STRAIN


def _rocks(
    b: PyramidLevel, solved: NormalEquations, calibration: Calibration, tilt_sigma_radians: float
) -> bool:
    """Return whether rocking would explain much that a steady camera's motion leaves over.

    A step of Gauss-Newton with either frame's tilt and height beside the motion tells by how much
    the squares would fall (a score test: Rao, Proc. Cambridge Phil. Soc. 44, 1948), and the motion
    change.
    """
    sigmas = rocking.mounting_sigmas(calibration, tilt_sigma_radians)
    if not len(sigmas):
        return False
    few = slice(None, None, -(-len(solved.points) // _SAMPLE_POINTS))
    points_b, residual, weight = solved.points[few], solved.residual[few], solved.weight[few]
    steady = solved.jacobian[few]
    gradients_b = -steady[:, :2]
    gradients_a = gradients_b @ solved.state.a_from_b.matrix[:2, :2].T
    shown_from_floor = rocking.shown_from_floor_by_each(calibration, sigmas)
    shifts_a = rocking.shifts(shown_from_floor, solved.state.a_from_b.apply(points_b))
    shifts_b = rocking.shifts(shown_from_floor, points_b)
    bent = rocking.slopes(gradients_a, gradients_b, shifts_a, shifts_b)
    jacobian = np.vstack([steady.T, bent]).T
    # The few stand for all.
    share = len(solved.points) / len(points_b)
    count = steady.shape[1]
    information = share * jacobian.T @ (jacobian * weight[:, None])
    information[:count, :count] += solved.prior
    information[count:, count:] += np.eye(2 * len(sigmas))
    pull = share * jacobian.T @ (weight * residual)
    try:
        step = np.linalg.solve(information, pull)
        alone = np.linalg.solve(information[:count, :count], pull[:count])
    except np.linalg.LinAlgError:
        return False
    gain = float(pull @ step - pull[:count] @ alone)
    change = step[:3] - alone[:3]
    moved = math.hypot(change[0], change[1]) + abs(change[2]) * float(np.abs(points_b).max())
    return bool(gain > _MIN_GAIN and moved > _MIN_CHANGE_PIXELS * b.metres_per_pixel)


def _ran_away(moved: Pose2, levels_a: Sequence[PyramidLevel], *, searched: bool) -> bool:
    most = _MAX_SHIFT_PIXELS * levels_a[-1].metres_per_pixel
    if searched and abs(moved.theta) <= _MAX_TURN_RADIANS:
        most = max(most, _MAX_SHIFT_SHARE * _reach(levels_a[0]))
    return moved.translation_length > most


def _systematic(finest: PyramidLevel) -> Float64Array:
    """Return the (3, 3) covariance of what no residual shows: interpolation, blur, smear."""
    sigma = _SYSTEMATIC_PIXELS * finest.metres_per_pixel
    return np.diag([sigma**2, sigma**2, (sigma / _reach(finest)) ** 2])


def _reach(level: PyramidLevel) -> float:
    """Return half of how far what a level shows is spread, metres."""
    # A column at a time: numpy is slow along an axis so short.
    return math.hypot(*(float(np.ptp(column)) for column in level.points.T)) / 2.0


def _sampled(level: PyramidLevel) -> PyramidLevel:
    """Return a level with some of its points, evenly taken."""
    step = -(-len(level.points) // _SAMPLE_POINTS)
    return replace(
        level,
        points=level.points[::step],
        values=level.values[::step],
        gradients=level.gradients[::step],
    )


def _refine_level(
    a: PyramidLevel,
    b: PyramidLevel,
    state: FitState,
    calibration: Calibration,
    sigmas: Float64Array,
    known: MotionPrior | None,
    min_pixels: float,
) -> NormalEquations | None:
    """Return the state refined on one level until a step moves it by less than `least_pixels`.

    None when the level does not determine it.
    """
    count = len(sigmas)
    shown_from_floor = rocking.shown_from_floor_by_each(calibration, sigmas)
    shifts_a = rocking.shifts(shown_from_floor, a.points)
    prior = np.diag(np.concatenate([np.zeros(5), np.ones(2 * count)]))
    if known is not None:
        prior[:3, :3] = invert(known.covariance)
    for _ in range(_MAX_ITERATIONS):
        floor_from_shown_a = invert(rocking.shown_from_floor(calibration, state.mounting_a))
        floor_b = apply_homography(state.a_from_b.inverse().matrix @ floor_from_shown_a, a.points)
        pixel_from_floor_b = b.pixel_from_metres @ rocking.shown_from_floor(
            calibration, state.mounting_b
        )
        pixels_b = apply_homography(pixel_from_floor_b, floor_b)
        seen = np.flatnonzero(pyramid.sample(b.inside, pixels_b) > 254.5)
        if len(seen) < _MIN_TEMPLATE_PIXELS:
            return None
        # Numpy takes so, and from rows, several times as fast as it indexes.
        points = np.take(floor_b.T, seen, axis=1).T
        pixels = np.take(pixels_b.T, seen, axis=1).T
        gradients_a = np.take(a.gradients, seen, axis=0)
        values = a.values[seen]
        gradients = gradients_a @ state.a_from_b.matrix[:2, :2]
        slopes = np.empty((5 + 2 * count, len(points)))
        slopes[:2] = -gradients.T
        slopes[2] = gradients[:, 0] * points[:, 1] - gradients[:, 1] * points[:, 0]
        slopes[3] = values
        slopes[4] = 1.0
        if count:
            shifts_b = rocking.shifts(shown_from_floor, points)
            slopes[5:] = rocking.slopes(
                gradients_a, gradients, np.take(shifts_a, seen, axis=2), shifts_b
            )
        jacobian = slopes.T
        residual = pyramid.sample(b.detail, pixels) - values
        off = _off_prior(state, sigmas, known)
        contrast = float(values.std())
        solved = _solve(jacobian, residual, prior, off, _MIN_NOISE_SHARE * contrast)
        if solved is None:
            return None
        step, weight = solved
        state = FitState(
            state.a_from_b @ Pose2(float(step[0]), float(step[1]), float(step[2])),
            state.mounting_a + step[5 : 5 + count] * sigmas,
            state.mounting_b + step[5 + count :] * sigmas,
        )
        reach = float(np.abs(points).max())
        moved = math.hypot(step[0], step[1]) + abs(step[2]) * reach
        if moved < min_pixels * b.metres_per_pixel:
            break
    # What is left over tells how well the motion is known; the least noise is for outliers alone.
    share = weight / weight.max()
    left = math.sqrt(float(np.sum(share * residual**2) / np.sum(share)))
    noise = max(left, _MIN_LEFT_SHARE * contrast, 1e-6)
    weight = share / (noise**2 * _CORRELATED_PIXELS)
    return NormalEquations(state, jacobian, pixels, points, residual, weight, prior)


def _off_prior(state: FitState, sigmas: Float64Array, known: MotionPrior | None) -> Float64Array:
    """Return (5 + 2 n,): by how much a state is off what is known beforehand."""
    off = np.zeros(5 + 2 * len(sigmas))
    if known is not None:
        apart = known.a_from_b.inverse() @ state.a_from_b
        off[:3] = apart.x, apart.y, apart.theta
    if len(sigmas):
        off[5:] = np.concatenate([state.mounting_a / sigmas, state.mounting_b / sigmas])
    return off


def _solve(
    jacobian: Float64Array,
    residual: Float64Array,
    prior: Float64Array,
    off: Float64Array,
    min_noise: float,
) -> tuple[Float64Array, Float64Array] | None:
    """Return one robust Gauss-Newton step (K,) and the weight (N,) of each residual.

    Parameters
    ----------
    jacobian : (N, K) float64
    residual : (N,) float64
    prior : (K, K) float64
        Information of what is known beforehand.
    off : (K,) float64
        By how much the state is off that.
    least_noise : float
        Of a residual, one standard deviation.
    """
    spread = SIGMA_PER_MAD * _median(np.abs(residual - _median(residual)))
    noise = max(spread, min_noise, 1e-6)
    weight = np.minimum(1.0, _HUBER_SIGMAS * noise / np.maximum(np.abs(residual), 1e-12))
    weight /= noise**2 * _CORRELATED_PIXELS
    weighted = jacobian * weight[:, None]
    information = jacobian.T @ weighted + prior
    try:
        step = -np.linalg.solve(information, weighted.T @ residual + prior @ off)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(step).all():
        return None
    return np.asarray(step, np.float64), weight


def _median(values: Float64Array) -> float:
    """Return numpy's median, without its search for what is not a number."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    return float(np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1].mean())
