"""Feature alignment: two sets of features to the transform between them, or why there is none."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from slamcli.core.config import MatchOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import FeatureAlignment, Features
from slamcli.stages.align.acceptance import (
    MatchedPoints,
    TransformFit,
    check_count,
    check_plausible,
    check_residuals,
    check_spread,
    check_unique,
)
from slamcli.stages.align.matching import match_descriptors
from slamcli.stages.align.models import MODELS
from slamcli.stages.align.ransac import Consensus, ransac, residuals_of
from slamcli.stages.align.rigid import RigidFit, fit_rigid

# Points crowd on the same few corners, in one octave and the next, and err together: on simulated
# floors of five kinds, noisy or not, a motion's variance is four to six times what it would be
# [guarded by benchmarks/accuracy.py].
_CORRELATED_MATCHES = 5.0

__all__ = [
    "MODELS",
    "Consensus",
    "RigidFit",
    "align",
    "count_agreeing",
    "fit_rigid",
    "match_descriptors",
    "ransac",
]


def align(
    features_a: Features,
    features_b: Features,
    options: MatchOptions,
    guess: Pose2 | None = None,
) -> FeatureAlignment:
    """Match two sets of features, fit a transform, and accept or reject it.

    Parameters
    ----------
    features_a, features_b : Features
        Of one kind and one unit.
    options : MatchOptions
    guess : Pose2 or None
        ``a_from_b`` as expected; keeps matches within the options' search radius.

    Returns
    -------
    FeatureAlignment
        With a one-line reason when it is rejected.
    """
    matches, _ = match_descriptors(
        features_a, features_b, options, None if guess is None else guess.matrix
    )
    pairs = _matched_points(features_a, features_b, matches, options)
    fit = _fit_by_consensus(pairs, options)
    if fit is not None and options.model == "rigid":
        fit = _fit_weighted(fit, pairs, options)
    if fit is None:
        return _no_fit(features_a, features_b, matches, options)
    inliers, count = fit.inliers, int(fit.inliers.sum())
    spread = max(
        _relative_spread(pairs.a[inliers], features_a.points),
        _relative_spread(pairs.b[inliers], features_b.points),
    )
    reason = (
        check_count(inliers, features_a, features_b, options)
        or check_residuals(fit, pairs.thresholds, options)
        or check_spread(count, spread, options)
        or check_plausible(fit.a_from_b, pairs.b[inliers], options)
        or check_unique(fit, pairs, options)
    )
    return FeatureAlignment(
        options.model,
        fit.a_from_b,
        fit.pose,
        fit.covariance,
        matches,
        inliers,
        fit.residuals,
        spread,
        reason,
    )


def count_agreeing(
    features_a: Features, features_b: Features, options: MatchOptions, a_from_b: Pose2
) -> int:
    """Return how many matches agree with a motion that is known, as inliers of `align` do."""
    matches, _ = match_descriptors(features_a, features_b, options, a_from_b.matrix)
    pairs = _matched_points(features_a, features_b, matches, options)
    motion = a_from_b.matrix
    residuals = residuals_of(motion[None], pairs.a, pairs.b, MODELS["rigid"])[0]
    agree = (residuals < pairs.thresholds) & _turned_alike(motion, pairs, options)
    return int(np.count_nonzero(agree))


def _matched_points(
    a: Features, b: Features, matches: Int32Array, options: MatchOptions
) -> MatchedPoints:
    index_a, index_b = matches[:, 0], matches[:, 1]
    sigmas_a = a.sigmas[index_a].astype(np.float64)
    sigmas_b = b.sigmas[index_b].astype(np.float64)
    return MatchedPoints(
        a.points[index_a].astype(np.float64),
        b.points[index_b].astype(np.float64),
        sigmas_a,
        sigmas_b,
        a.angles[index_a] - b.angles[index_b],
        _thresholds(sigmas_a, sigmas_b, options),
    )


def _thresholds(
    sigmas_a: Float64Array, sigmas_b: Float64Array, options: MatchOptions
) -> Float64Array:
    """Return (M,): how far a match may lie from the transform."""
    if options.threshold is not None:
        return np.full(len(sigmas_a), options.threshold)
    variance = np.max(sigmas_a, axis=1) ** 2 + np.max(sigmas_b, axis=1) ** 2
    return np.asarray(options.threshold_sigmas * np.sqrt(variance))


def _fit_by_consensus(pairs: MatchedPoints, options: MatchOptions) -> TransformFit | None:
    """Return the transform that most matches agree with (RANSAC), or None."""
    model = MODELS[options.model]
    consensus = ransac(
        pairs.a,
        pairs.b,
        model,
        pairs.thresholds,
        confidence=options.confidence,
        max_iterations=options.max_iterations,
        seed=options.seed,
    )
    if consensus is None:
        return None
    inliers = consensus.inliers & _turned_alike(consensus.a_from_b, pairs, options)
    if np.count_nonzero(inliers) < model.sample_size:
        return None
    return TransformFit(
        consensus.a_from_b, None, None, consensus.residuals, consensus.inliers, inliers
    )


def _fit_weighted(
    start: TransformFit, pairs: MatchedPoints, options: MatchOptions
) -> TransformFit | None:
    """Return the rigid motion by robust, weighted least squares over the inliers, or None."""
    kept = start.inliers
    fit = fit_rigid(
        pairs.a[kept],
        pairs.b[kept],
        pairs.sigmas_a[kept],
        pairs.sigmas_b[kept],
        Pose2.from_matrix(start.a_from_b),
    )
    if fit is None:
        return None
    matrix = fit.a_from_b.matrix
    residuals = residuals_of(matrix[None], pairs.a, pairs.b, MODELS["rigid"])[0]
    near = residuals < pairs.thresholds
    inliers = near & _turned_alike(matrix, pairs, options)
    covariance = _CORRELATED_MATCHES * fit.covariance
    return TransformFit(matrix, fit.a_from_b, covariance, residuals, near, inliers)


def _turned_alike(a_from_b: Float64Array, pairs: MatchedPoints, options: MatchOptions) -> BoolArray:
    """Return (M,): whose surroundings are turned as the transform turns; all, where none is known.

    Affinities and homographies turn each direction differently.
    """
    if options.model not in {"rigid", "similarity"}:
        return np.ones(len(pairs.turns), np.bool_)
    difference = pairs.turns - np.arctan2(a_from_b[1, 0], a_from_b[0, 0])
    return np.asarray(~(np.cos(difference) < np.cos(options.max_angle_radians)))


def _no_fit(
    a: Features, b: Features, matches: Int32Array, options: MatchOptions
) -> FeatureAlignment:
    none = np.zeros(len(matches), dtype=np.bool_)
    reason = check_count(none, a, b, options) or "the matches do not determine a transform"
    residuals = np.full(len(matches), np.nan)
    return FeatureAlignment(options.model, None, None, None, matches, none, residuals, 0.0, reason)


def _relative_spread(inliers: Float64Array, points: Float32Array) -> float:
    """Return the narrower extent of (N, 2) inliers over that of all points of the view."""
    if len(inliers) < 2:
        return 0.0
    everywhere = _narrower_extent(points.astype(np.float64))
    return _narrower_extent(inliers) / everywhere if everywhere > 0.0 else 0.0


def _narrower_extent(points: Float64Array) -> float:
    """Return the standard deviation of (N, 2) points in the direction where it is least."""
    smallest = np.linalg.eigvalsh(np.cov(points.T))[0]
    return float(np.sqrt(max(smallest, 0.0)))
