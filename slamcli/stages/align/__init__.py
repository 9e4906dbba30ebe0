"""From two sets of features to the transform between them, or to why there is none."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, Int32Array
from slamcli.core.config import MatchOptions
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.records import FeatureAlignment, Features
from slamcli.stages.align.matching import match_descriptors
from slamcli.stages.align.models import MODELS
from slamcli.stages.align.ransac import Consensus, ransac, residuals_of
from slamcli.stages.align.rigid import RigidFit, fit_rigid

# A rival as large as it must be to matter is drawn within this many samples.
_RIVAL_ITERATIONS = 1000
# Nearer than this many inlier thresholds it is the same motion, of matches that just missed it.
_RIVAL_THRESHOLDS = 3.0
# Points crowd on the same few corners, in one octave and the next, and err together: on simulated
# floors of five kinds, noisy or not, a motion's variance is four to six times what it would be.
_CORRELATED_MATCHES = 5.0

__all__ = [
    "MODELS",
    "Consensus",
    "RigidFit",
    "align",
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
    """Match two sets of features, fit a transform, and judge whether to believe it.

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
        With a one-line reason when it is not to be believed.
    """
    matches, _ = match_descriptors(
        features_a, features_b, options, None if guess is None else guess.matrix
    )
    points_a = features_a.points[matches[:, 0]].astype(np.float64)
    points_b = features_b.points[matches[:, 1]].astype(np.float64)
    sigmas_a = features_a.sigmas[matches[:, 0]].astype(np.float64)
    sigmas_b = features_b.sigmas[matches[:, 1]].astype(np.float64)
    thresholds = _thresholds(sigmas_a, sigmas_b, options)
    model = MODELS[options.model]
    consensus = ransac(
        points_a,
        points_b,
        model,
        thresholds,
        confidence=options.confidence,
        max_iterations=options.max_iterations,
        seed=options.seed,
    )
    if consensus is None:
        return _nothing(features_a, features_b, matches, options)
    a_from_b, near = consensus.a_from_b, consensus.inliers
    inliers = near & _turned_alike(features_a, features_b, matches, a_from_b, options)
    if np.count_nonzero(inliers) < model.sample_size:
        return _nothing(features_a, features_b, matches, options)
    residuals, pose, covariance = consensus.residuals, None, None
    if options.model == "rigid":
        fit = fit_rigid(
            points_a[inliers],
            points_b[inliers],
            sigmas_a[inliers],
            sigmas_b[inliers],
            Pose2.from_matrix(a_from_b),
        )
        if fit is None:
            return _nothing(features_a, features_b, matches, options)
        pose, a_from_b = fit.a_from_b, fit.a_from_b.matrix
        covariance = _CORRELATED_MATCHES * fit.covariance
        residuals = residuals_of(a_from_b[None], points_a, points_b, model)[0]
        near = residuals < thresholds
        inliers = near & _turned_alike(features_a, features_b, matches, a_from_b, options)
    spread = max(
        _spread(points_a[inliers], features_a.points), _spread(points_b[inliers], features_b.points)
    )
    reason = (
        _too_few(inliers, len(features_a), len(features_b), options)
        or _too_loose(residuals, thresholds, inliers, spread, options)
        or _implausible(a_from_b, points_b[inliers], options)
        or _ambiguous(a_from_b, inliers, ~near, points_a, points_b, thresholds, options)
    )
    return FeatureAlignment(
        options.model, a_from_b, pose, covariance, matches, inliers, residuals, spread, reason
    )


def _turned_alike(
    a: Features,
    b: Features,
    matches: Int32Array,
    a_from_b: Float64Array,
    options: MatchOptions,
) -> BoolArray:
    """Return (M,): whose surroundings are turned as the transform turns; all, where none is known.

    Affinities and homographies turn each direction differently.
    """
    if options.model not in {"rigid", "similarity"}:
        return np.ones(len(matches), np.bool_)
    turn = np.arctan2(a_from_b[1, 0], a_from_b[0, 0])
    odd = a.angles[matches[:, 0]] - b.angles[matches[:, 1]] - turn
    return np.asarray(~(np.cos(odd) < np.cos(options.max_angle_radians)))


def _ambiguous(
    a_from_b: Float64Array,
    inliers: BoolArray,
    rest: BoolArray,
    points_a: Float64Array,
    points_b: Float64Array,
    thresholds: Float64Array,
    options: MatchOptions,
) -> str:
    """Return why the matches do not single out one transform, or nothing.

    Floors that repeat, and lines that look alike, let another motion explain nearly as many of the
    matches that the best one leaves over.
    """
    best = int(inliers.sum())
    if np.count_nonzero(rest) < options.max_rival_share * best:
        return ""
    rival = ransac(
        points_a[rest],
        points_b[rest],
        MODELS[options.model],
        thresholds[rest],
        confidence=options.confidence,
        max_iterations=min(options.max_iterations, _RIVAL_ITERATIONS),
        seed=options.seed,
    )
    if rival is None:
        return ""
    second = int(rival.inliers.sum())
    if second < options.max_rival_share * best:
        return ""
    apart = apply_homography(rival.a_from_b, points_b) - apply_homography(a_from_b, points_b)
    if np.median(np.linalg.norm(apart, axis=1)) < _RIVAL_THRESHOLDS * np.median(thresholds):
        return ""
    return f"ambiguous: {best} matches agree on one motion and {second} on another"


def _thresholds(
    sigmas_a: Float64Array, sigmas_b: Float64Array, options: MatchOptions
) -> Float64Array:
    """Return (M,): how far a match may lie from the transform."""
    if options.threshold is not None:
        return np.full(len(sigmas_a), options.threshold)
    variance = np.max(sigmas_a, axis=1) ** 2 + np.max(sigmas_b, axis=1) ** 2
    return np.asarray(options.threshold_sigmas * np.sqrt(variance))


def _nothing(
    a: Features, b: Features, matches: Int32Array, options: MatchOptions
) -> FeatureAlignment:
    none = np.zeros(len(matches), dtype=np.bool_)
    return FeatureAlignment(
        options.model,
        None,
        None,
        None,
        matches,
        none,
        np.full(len(matches), np.nan),
        0.0,
        _too_few(none, len(a), len(b), options) or "the matches do not determine a transform",
    )


def _too_few(inliers: BoolArray, count_a: int, count_b: int, options: MatchOptions) -> str:
    """Return why there is too little to go by, or nothing."""
    needed = options.min_inliers
    agree, count = int(inliers.sum()), len(inliers)
    if min(count_a, count_b) < needed:
        return f"{count_a} and {count_b} features; at least {needed} of each are needed"
    if count < needed:
        return f"{count} matches; at least {needed} are needed"
    if agree < needed:
        return f"{agree} inliers of {count} matches; at least {needed} are needed"
    if agree < options.min_inlier_ratio * count:
        return (
            f"{agree} inliers of {count} matches ({agree / count:.0%}); "
            f"at least {options.min_inlier_ratio:.0%} must agree"
        )
    return ""


def _too_loose(
    residuals: Float64Array,
    thresholds: Float64Array,
    inliers: BoolArray,
    spread: float,
    options: MatchOptions,
) -> str:
    """Return why the inliers do not carry a transform, or nothing."""
    relative = float(np.sqrt(np.mean((residuals[inliers] / thresholds[inliers]) ** 2)))
    if relative > options.max_residual_ratio:
        return (
            f"the {int(inliers.sum())} inliers agree no better than by chance: "
            f"rms residual {relative:.2f} of the threshold, at most "
            f"{options.max_residual_ratio:.2f} is believed"
        )
    if spread < options.min_spread:
        return (
            f"the {int(inliers.sum())} inliers crowd on {spread:.1%} of the view's extent; "
            f"at least {options.min_spread:.0%} is needed"
        )
    return ""


def _implausible(a_from_b: Float64Array, points_b: Float64Array, options: MatchOptions) -> str:
    """Return why a camera over a floor cannot have made this transform, or nothing.

    The scales in the two directions are the singular values of the Jacobian at the inliers.
    """
    w = points_b @ a_from_b[2, :2] + a_from_b[2, 2]
    mapped = apply_homography(a_from_b, points_b)
    jacobian = (a_from_b[:2, :2] - mapped[:, :, None] * a_from_b[2, :2]) / w[:, None, None]
    scales = np.linalg.svd(jacobian, compute_uv=False)
    largest, smallest = float(scales.max()), float(scales.min())
    if largest > options.max_scale or smallest < 1.0 / options.max_scale:
        odd = largest if largest > options.max_scale else smallest
        return (
            f"a scale of {odd:.3g} among the inliers; believed are "
            f"{1.0 / options.max_scale:.3g} to {options.max_scale:.3g}"
        )
    stretch = float((scales[:, 0] / scales[:, 1]).max())
    if stretch > options.max_stretch:
        return (
            f"a stretch of {stretch:.3g} among the inliers; "
            f"at most {options.max_stretch:.3g} is believed"
        )
    return ""


def _spread(inliers: Float64Array, points: Float32Array) -> float:
    """Return the narrower extent of (N, 2) inliers over that of all points of the view."""
    if len(inliers) < 2:
        return 0.0
    everywhere = _narrower_extent(points.astype(np.float64))
    return _narrower_extent(inliers) / everywhere if everywhere > 0.0 else 0.0


def _narrower_extent(points: Float64Array) -> float:
    """Return the standard deviation of (N, 2) points in the direction where it is least."""
    smallest = np.linalg.eigvalsh(np.cov(points.T))[0]
    return float(np.sqrt(max(smallest, 0.0)))
