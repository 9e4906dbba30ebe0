"""Photometric refinement: the rigid motion between two views by Lucas-Kanade alignment.

An inverse-compositional alignment (Baker and Matthews, IJCV 56, 2004) of a rigid motion with gain
and offset, on locally normalised gray, with Huber weights. A camera that rocks shows the floor
under a slightly other homography each time: both frames' pitch, roll and height are estimated with
the motion, with a prior of how much they are expected to vary.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import PyramidLevel, SampledLevel
from slamcli.core.robust import SIGMA_PER_MAD
from slamcli.stages.dense import rocking
from slamcli.stages.dense.covariance import FitState, NormalEquations, covariances_of
from slamcli.stages.dense.noise_points import without_noise
from slamcli.stages.dense.photometric_residuals import (
    MIN_TEMPLATE_PIXELS,
    LevelResiduals,
    Linearisation,
    MotionPrior,
    WarpModel,
    sampled,
)

_MAX_ITERATIONS = 12
# The last step is smaller than this. On coarser levels, and where all points follow a sample that
# has converged, it may be larger: it leaves only a small share of itself
# [guarded by benchmarks/accuracy.py and benchmarks/streaming.py].
_CONVERGED_PIXELS, _NEARLY_CONVERGED_PIXELS = 0.003, 0.03
# Of a sparse view's second level [guarded by benchmarks/streaming.py].
_SPARSE_POINTS_OF_SECOND = 1000
_HUBER_SIGMAS = 1.5
# Residuals whose spread stands for that of all.
_SPREAD_POINTS = 2000
# On a floor of plain lines nearly every pixel fits, while a line's end, which alone determines the
# motion along it, does not: it must not pass for an outlier. Noise is taken to be at least this
# share of the contrast, for the weights of outliers and for the covariance
# [guarded by benchmarks/robustness.py: textureless-course].
_MIN_NOISE_SHARE = 0.2
_MIN_RESIDUAL_SHARE = 0.03
# Interpolation and blur correlate about this many neighbouring residuals
# [guarded by benchmarks/accuracy.py: NEES].
_CORRELATED_PIXELS = 24.0
# Error by interpolation, blur and smear, which no residual shows: on the safe side, and usually
# [benchmarks/sigmas.py: errors of 0.004 to 0.02 pixels in all].
_MAX_SYSTEMATIC_PIXELS = 0.02
_SYSTEMATIC_PIXELS = 0.005
# A refinement that runs away from its start by more than this, in pixels of the coarsest level, has
# found something else. From a search, whose rotations are steps apart, a motion that turns by no
# more than half a step may shift by this share of what is seen
# [guarded by benchmarks/robustness.py: tiles].
_MAX_SHIFT_PIXELS = 6.0
_MAX_SHIFT_SHARE = 0.12
_MAX_TURN_RADIANS = math.radians(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class PhotometricFit:
    """A refined motion.

    Attributes
    ----------
    a_from_b : Pose2
    predicted_covariance : (3, 3) float64
        Of x, y (m), theta (rad) in b's own axes, as gradients and noise predict it, on the safe
        side: for whether the motion is determined.
    covariance : (3, 3) float64
        Likewise, as the residuals show it.
    view_a_from_view_b : (3, 3) float64
        Metres to metres, as the views show the floor: the motion, and the difference of each
        frame's tilt and height from the calibration's.
    mounting_a, mounting_b : (K,) float64
        That difference, as `rocking.shown_from_floor` takes it; (0,) for a steady camera.
    rocking_suspected : bool
        Whether the residuals suggest that the camera rocked more than was allowed for.
    """

    a_from_b: Pose2
    predicted_covariance: Float64Array
    covariance: Float64Array
    view_a_from_view_b: Float64Array
    mounting_a: Float64Array
    mounting_b: Float64Array
    rocking_suspected: bool


@dataclass(frozen=True, slots=True, eq=False)
class RefinementAssumptions:
    """What a refinement assumes about its start and about the camera.

    Attributes
    ----------
    prior : MotionPrior or None
        Estimated together with what the pixels show.
    from_search : bool
        Whether the start is a peak of a `search`, which may lie farther from the truth.
    rocking : PhotometricFit or None
        Of other pixels or a narrower tilt sigma: its rocking is where to start.
    suspected_tilt_radians : float
        Tilt sigma of the rocking that residuals of a steady camera are tested for.
    """

    prior: MotionPrior | None = None
    from_search: bool = False
    rocking: PhotometricFit | None = None
    suspected_tilt_radians: float = 0.0


NO_ASSUMPTIONS = RefinementAssumptions()


def refine(
    levels_a: Sequence[PyramidLevel],
    levels_b: Sequence[PyramidLevel | SampledLevel],
    a_from_b: Pose2,
    calibration: Calibration,
    tilt_sigma_radians: float,
    assumptions: RefinementAssumptions = NO_ASSUMPTIONS,
) -> PhotometricFit | None:
    """Refine a motion on the pixels of two views; None when they do not determine it.

    Parameters
    ----------
    levels_a, levels_b : sequence of PyramidLevel
        From `make_levels`, of views of one resolution, from fine to coarse; of a sparse view b, the
        finest is a SampledLevel.
    a_from_b : Pose2
        A start within a few pixels of the truth on the coarsest of them.
    calibration : Calibration
    tilt_sigma_radians : float
        By how much the camera's pitch and roll vary from frame to frame; 0 for a steady camera.
    assumptions : RefinementAssumptions
    """
    sigmas = rocking.mounting_sigmas(calibration, tilt_sigma_radians)
    model = WarpModel(calibration, sigmas, assumptions.prior)
    state, other = model.start(a_from_b), assumptions.rocking
    if other is not None:
        state = FitState(a_from_b, other.mounting_a, other.mounting_b)
    solved = _coarse_to_fine(levels_a, levels_b, model, state)
    if solved is None:
        return None
    moved = a_from_b.inverse() @ solved.state.a_from_b
    if _ran_away(moved, levels_a, from_search=assumptions.from_search):
        return None
    along_edges = rocking.slopes_along_edges(solved, calibration, sigmas)
    covariances = covariances_of(levels_b[0], solved, along_edges)
    if covariances is None:
        return None
    predicted, shown = covariances
    state = solved.state
    shown_a = rocking.shown_from_floor(calibration, state.mounting_a)
    shown_b = rocking.shown_from_floor(calibration, state.mounting_b)
    suspected = rocking.exceeds_sigmas(state, sigmas) or (
        not len(sigmas)
        and rocking.explains_residuals(
            levels_b[0], solved, calibration, assumptions.suspected_tilt_radians
        )
    )
    return PhotometricFit(
        state.a_from_b,
        predicted + _systematic(levels_a[0], _MAX_SYSTEMATIC_PIXELS),
        shown + _systematic(levels_a[0], _SYSTEMATIC_PIXELS),
        shown_a @ state.a_from_b.matrix @ invert(shown_b),
        state.mounting_a,
        state.mounting_b,
        suspected,
    )


def _coarse_to_fine(
    levels_a: Sequence[PyramidLevel],
    levels_b: Sequence[PyramidLevel | SampledLevel],
    model: WarpModel,
    state: FitState,
) -> NormalEquations | None:
    """Refine a state level by level; return the finest one's equations, None where one fails."""
    solved: NormalEquations | None = None
    sparse = isinstance(levels_b[0], SampledLevel)
    for level_a, level_b in zip(reversed(levels_a), reversed(levels_b), strict=True):
        if len(level_a.points) < MIN_TEMPLATE_PIXELS:
            return None
        finest = level_a is levels_a[0]
        level_a = without_noise(level_a, level_b, model, state, sparse=sparse)
        for sample, min_pixels in _samples(level_a, finest=finest, sparse=sparse):
            solved = _refine_level(sample, level_b, model, state, min_pixels)
            if solved is None:
                return None
            state = solved.state
    return solved


def _samples(a: PyramidLevel, *, finest: bool, sparse: bool) -> list[tuple[PyramidLevel, float]]:
    """Return the points that a level is refined by in turn, and when each has converged, pixels.

    A sample of the points converges first: all of them then take a step or two.
    """
    some = sampled(a, _SPARSE_POINTS_OF_SECOND) if sparse and not finest else sampled(a)
    if not finest:
        return [(some, _NEARLY_CONVERGED_PIXELS)]
    # A sparse view is read from the picture anew at each step.
    converged = _NEARLY_CONVERGED_PIXELS if sparse else _CONVERGED_PIXELS
    if some is a:
        return [(a, converged)]
    return [(some, _NEARLY_CONVERGED_PIXELS), (a, converged)]


def _refine_level(
    a: PyramidLevel,
    b: PyramidLevel | SampledLevel,
    model: WarpModel,
    state: FitState,
    min_pixels: float,
) -> NormalEquations | None:
    """Refine a state on one level until a step moves no point by `min_pixels`.

    None when the level does not determine it.
    """
    residuals = LevelResiduals.of(a, b, model)
    prior = model.prior_information()
    for _ in range(_MAX_ITERATIONS):
        before = state
        linear = residuals.linearise(state)
        solved = None if linear is None else _solve(linear, prior, model.prior_deviation(state))
        if linear is None or solved is None:
            return None
        step, weight = solved
        state = model.moved(state, step)
        moved = math.hypot(step[0], step[1]) + abs(step[2]) * residuals.reach_metres
        if moved < min_pixels * b.metres_per_pixel:
            break
    assert linear is not None
    # The residuals themselves give the noise: its lower bound in a step is for outliers alone.
    share = weight / weight.max()
    left = math.sqrt(float(np.sum(share * linear.residual**2) / np.sum(share)))
    noise = max(left, _MIN_RESIDUAL_SHARE * linear.contrast, 1e-6)
    weight = share / (noise**2 * _CORRELATED_PIXELS)
    points = residuals.points(before, linear.places.chosen)
    return NormalEquations(
        state, linear.slopes, linear.places, points, linear.residual, weight, prior
    )


def _solve(
    linear: Linearisation, prior: Float64Array, deviation: Float64Array
) -> tuple[Float64Array, Float64Array] | None:
    """Return one robust Gauss-Newton step (K,) and the weight (N,) of each residual.

    Parameters
    ----------
    linear : Linearisation
    prior : (K, K) float64
        Information of the priors.
    deviation : (K,) float64
        Of the state from them.
    """
    residual = linear.residual
    some = residual[:: -(-len(residual) // _SPREAD_POINTS)]
    spread = SIGMA_PER_MAD * _median(np.abs(some - _median(some)))
    noise = max(spread, _MIN_NOISE_SHARE * linear.contrast, 1e-6)
    weight = np.minimum(1.0, _HUBER_SIGMAS * noise / np.maximum(np.abs(residual), 1e-12))
    weight /= noise**2 * _CORRELATED_PIXELS
    weighted = linear.slopes * weight
    information = weighted @ linear.slopes.T + prior
    try:
        step = -np.linalg.solve(information, weighted @ residual + prior @ deviation)
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


def _ran_away(moved: Pose2, levels_a: Sequence[PyramidLevel], *, from_search: bool) -> bool:
    limit_metres = _MAX_SHIFT_PIXELS * levels_a[-1].metres_per_pixel
    if from_search and abs(moved.theta) <= _MAX_TURN_RADIANS:
        limit_metres = max(limit_metres, _MAX_SHIFT_SHARE * _reach(levels_a[0]))
    return moved.translation_length > limit_metres


def _systematic(finest: PyramidLevel, sigma_pixels: float) -> Float64Array:
    """Return the (3, 3) covariance of what no residual shows: interpolation, blur, smear."""
    sigma = sigma_pixels * finest.metres_per_pixel
    return np.diag([sigma**2, sigma**2, (sigma / _reach(finest)) ** 2])


def _reach(level: PyramidLevel) -> float:
    """Return half the extent of what a level shows, metres."""
    # A column at a time: numpy is slow along an axis so short.
    return math.hypot(*(float(np.ptp(column)) for column in level.points.T)) / 2.0
