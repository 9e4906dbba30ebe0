"""Photometric refinement of a motion hypothesis.

A rigid motion is refined (1) with a steady camera; where the pixels then still disagree, (2) with a
camera that rocks, first by as much as is expected, then by more. Where most of the informative
patches disagree with the features' motion, both are done (3) with obstacles masked, until most of
the floor agrees with a fit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import PyramidLevel
from slamcli.registration import criteria
from slamcli.registration.hypothesis import (
    MotionHypothesis,
    PyramidPair,
    max_variance,
    photometric_score,
    same_motion,
    score_refined,
)
from slamcli.stages import dense

# Sigma up to which a refined motion replaces the features', as a share of the camera's range: twice
# what is accepted of a searched motion. A tilt that varies much makes the motion look less certain
# than it is, and the features' own is then off by millimetres
# [benchmarks/robustness.py: rocking on asphalt, RPE 0.12 mm, and 1.9 mm at half of it].
_MAX_SIGMA_SHARE = 0.015


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """A motion to be refined, and what is known of it before the first step.

    Attributes
    ----------
    pair : PyramidPair
    pose : Pose2
    start : MotionHypothesis or None
        The pose as the features measured it, with its score; None where a search or a guess led
        to it.
    steady : MotionHypothesis or None
        Its refinement on all of the floor with a steady camera, if that was made.
    calibration : Calibration
    options : MapperOptions
    """

    pair: PyramidPair
    pose: Pose2
    start: MotionHypothesis | None
    steady: MotionHypothesis | None
    calibration: Calibration
    options: MapperOptions

    @property
    def tilt_sigma_radians(self) -> float:
        """By how much the camera's tilt is expected to vary, one standard deviation."""
        return math.radians(self.options.tilt_sigma_degrees)

    @property
    def levels_b(self) -> tuple[PyramidLevel, ...]:
        """Of view b: features come within a pixel of the finest levels, a search does not."""
        return self.pair.b if self.start is None else self.pair.b[:2]


@dataclass(frozen=True, slots=True, eq=False)
class _Progress:
    """What the steps so far have led to.

    Attributes
    ----------
    best : MotionHypothesis or None
    levels_a : tuple of PyramidLevel
        Of view a, to refine on.
    masked : bool
        Whether points on obstacles are left out of them.
    rocking : PhotometricFit or None
        A fit with rocking that the next one starts at.
    """

    best: MotionHypothesis | None
    levels_a: tuple[PyramidLevel, ...]
    masked: bool
    rocking: dense.PhotometricFit | None = None


def refine_hypothesis(
    pair: PyramidPair,
    pose: Pose2,
    covariance: Float64Array | None,
    calibration: Calibration,
    options: MapperOptions,
) -> MotionHypothesis | None:
    """Refine a motion on the pixels, where that makes them agree better, and score it.

    Parameters
    ----------
    pair : PyramidPair
    pose : Pose2
    covariance : (3, 3) float64 or None
        From the features; None for what a search or a guess led to.
    calibration : Calibration
    options : MapperOptions

    Returns
    -------
    MotionHypothesis or None
        None where neither features nor pixels determine the motion.
    """
    if covariance is None:
        return _best_refinement(_Problem(pair, pose, None, None, calibration, options))
    if not options.refine:
        return photometric_score(pair, pose, covariance, pose.matrix)
    problem = _Problem(pair, pose, None, None, calibration, options)
    refined = dense.refine(
        pair.a[:2],
        pair.b[:2],
        pose,
        calibration,
        0.0,
        dense.RefinementAssumptions(suspected_tilt_radians=problem.tilt_sigma_radians),
    )
    steady = None
    if refined is not None:
        steady = score_refined(pair, refined)
        near = not criteria.diverged(pose, steady.pose, pair)
        if near and criteria.explains_all(steady) and _is_determined(steady, covariance, problem):
            # As on most floors: no other camera model needs to be tried.
            return steady
    start = photometric_score(pair, pose, covariance, pose.matrix)
    return _best_refinement(replace(problem, start=start, steady=steady))


def _best_refinement(problem: _Problem) -> MotionHypothesis | None:
    """Return the best of a start and its refinements, with a steady camera and a rocking one."""
    progress = _mask_obstacles(problem)
    sigma = problem.tilt_sigma_radians
    tilts = (0.0, sigma, criteria.SETTINGS.max_rocking_sigmas * sigma)
    # A little tilt shifts what lies far off by much: it is never compared without.
    for tilt in tilts[1:] if problem.pair.far else tilts:
        if tilt == 0.0:
            progress = _refine_steady(problem, progress)
        elif _needs_rocking(problem, progress.best, tilt):
            progress = _refine_rocking(problem, progress, tilt)
        else:
            break
    best, start = progress.best, problem.start
    if best is not None and start is not None and criteria.pulled_away(start, best, problem.pair):
        return start
    return best


def _mask_obstacles(problem: _Problem) -> _Progress:
    """Return the start, with obstacles masked if most of what is seen is taken to be obstacles."""
    pair, start = problem.pair, problem.start
    if start is None:
        return _Progress(None, pair.a, masked=False)
    if not criteria.mostly_obstructed(start):
        return _Progress(start, pair.a[:2], masked=False)
    # Obstacles would pull the motion to their own.
    kept = dense.keep_agreeing_points(pair.a[:2], pair.b[0], start.view_a_from_view_b)
    return _Progress(start, kept, masked=True)


def _refine_steady(problem: _Problem, progress: _Progress) -> _Progress:
    """Refine with a steady camera, unless that was done before."""
    if problem.steady is not None and not progress.masked:
        return _keep_better(problem, progress, problem.steady, None, 0.0)
    refined = _refine(problem, progress, 0.0)
    if refined is None:
        return progress
    return _keep_better(problem, progress, score_refined(problem.pair, refined), refined, 0.0)


def _needs_rocking(problem: _Problem, best: MotionHypothesis | None, tilt: float) -> bool:
    """Return whether to let the camera rock, given the best fit with less of it."""
    if best is not None and criteria.explained_by_steady_camera(best):
        return False
    # On bare lines, where there are no features, a large tilt passes for a turn.
    if tilt <= problem.tilt_sigma_radians or problem.start is not None:
        return True
    return best is not None and best.includes_rocking and best.rocking_suspected


def _refine_rocking(problem: _Problem, progress: _Progress, tilt: float) -> _Progress:
    """Refine with a camera whose tilt varies by a sigma, radians, from the best rocking so far."""
    refined = _refine(problem, progress, tilt)
    if refined is None:
        return progress
    fit = score_refined(problem.pair, refined)
    if progress.best is not None and fit.correlation > progress.best.correlation:
        # From the start alone, a refinement with more rocking may diverge.
        progress = replace(progress, rocking=refined)
        if progress.masked:
            levels_a = dense.keep_agreeing_points(
                problem.pair.a[:2], problem.pair.b[0], fit.view_a_from_view_b
            )
            progress = replace(progress, levels_a=levels_a)
    return _keep_better(problem, progress, fit, refined, tilt)


def _refine(problem: _Problem, progress: _Progress, tilt: float) -> dense.PhotometricFit | None:
    rocking = progress.rocking
    return dense.refine(
        progress.levels_a,
        problem.levels_b,
        problem.pose if rocking is None else rocking.a_from_b,
        problem.calibration,
        tilt,
        dense.RefinementAssumptions(
            from_search=problem.start is None,
            rocking=rocking,
            suspected_tilt_radians=problem.tilt_sigma_radians,
        ),
    )


def _keep_better(
    problem: _Problem,
    progress: _Progress,
    fit: MotionHypothesis,
    refined: dense.PhotometricFit | None,
    tilt: float,
) -> _Progress:
    """Take a fit for the best one if it is better and follows no obstacle."""
    best = progress.best
    # A rocking camera makes most of the floor disagree too, until it is modelled.
    if (
        progress.masked
        and criteria.mostly_obstructed(fit)
        and criteria.diverged(problem.pose, fit.pose, problem.pair)
    ):
        return progress
    if best is not None and not (
        criteria.better(fit, best, rocking=tilt > 0.0)
        and _is_determined(fit, best.predicted_covariance, problem)
    ):
        return progress
    if progress.masked and refined is not None and not criteria.mostly_obstructed(fit):
        # The rocking made the floor disagree, no obstacle: nothing needs to be masked any more.
        best = _refine_unmasked(problem, fit, refined, tilt)
        return replace(progress, best=best, levels_a=problem.pair.a[:2], masked=False)
    return replace(progress, best=fit)


def _refine_unmasked(
    problem: _Problem, fit: MotionHypothesis, refined: dense.PhotometricFit, tilt: float
) -> MotionHypothesis:
    """Refine a fit of the agreeing patches alone on all of the floor; return the better one."""
    pair = problem.pair
    unmasked = dense.refine(
        pair.a[:2],
        pair.b[:2],
        fit.pose,
        problem.calibration,
        tilt,
        dense.RefinementAssumptions(rocking=refined),
    )
    if unmasked is None:
        return fit
    scored = score_refined(pair, unmasked)
    return scored if scored.evidence > fit.evidence else fit


def _is_determined(fit: MotionHypothesis, other: Float64Array, problem: _Problem) -> bool:
    """Return whether a motion is known well enough in every direction, or as well as another."""
    limit = (_MAX_SIGMA_SHARE * problem.calibration.max_range_metres) ** 2
    return fit.max_variance <= max(limit, max_variance(other))


def converges_to(pair: PyramidPair, guess: Pose2, fit: MotionHypothesis) -> bool:
    """Return whether a guess, refined, would end at a fit that leaves nothing unexplained."""
    return criteria.explains_all(fit) and same_motion(fit.pose, guess, pair)


def refine_on_near_view(
    near: PyramidPair, fit: MotionHypothesis, calibration: Calibration, options: MapperOptions
) -> MotionHypothesis:
    """Refine a far view's fit on the near view too, where that shares enough of the floor.

    The far view's evidence is kept: it distinguished this motion from its rivals.
    """
    tilt = math.radians(options.tilt_sigma_degrees)
    prior = dense.MotionPrior(fit.pose, fit.predicted_covariance)
    assumptions = dense.RefinementAssumptions(prior=prior)
    refined = dense.refine(near.a[:2], near.b[:2], fit.pose, calibration, tilt, assumptions)
    if refined is None:
        return fit
    sharper = score_refined(near, refined)
    if sharper.agreement.overlap < options.min_overlap:
        return fit
    return replace(sharper, evidence=fit.evidence, correlation=fit.correlation)
