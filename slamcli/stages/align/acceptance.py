"""Acceptance gates of a feature fit; each returns the reason for rejection, or ""."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.config import MatchOptions
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.records import Features
from slamcli.stages.align.models import MODELS
from slamcli.stages.align.ransac import ransac

# Within this many samples a rival of half the smallest share of inliers that is accepted (5 % of
# the matches) is drawn, in pairs, with 95 % probability.
_MAX_RIVAL_ITERATIONS = 1000
# Nearer than this many inlier thresholds it is the same motion, of matches that just missed it
# [guarded by tests/stages/test_align.py].
_SAME_MOTION_THRESHOLDS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoints:
    """The two points of each match, what they may err by, and how far apart an inlier may be.

    Attributes
    ----------
    a, b : (M, 2) float64
        Metres, each in its own robot frame.
    sigmas_a, sigmas_b : (M, 2) float64
        Metres, along and across the line of sight.
    turns : (M,) float32
        Radians by which the surroundings are turned from b to a; nan where that is not known.
    thresholds : (M,) float64
        Metres.
    """

    a: Float64Array
    b: Float64Array
    sigmas_a: Float64Array
    sigmas_b: Float64Array
    turns: Float32Array
    thresholds: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class TransformFit:
    """A transform fitted to matches, and which of them agree with it.

    Attributes
    ----------
    a_from_b : (3, 3) float64
    pose : Pose2 or None
        The same when the model is rigid.
    covariance : (3, 3) float64 or None
        Of `pose`.
    residuals : (M,) float64
        Metres.
    near : (M,) bool
        Whose residual is below the threshold.
    inliers : (M,) bool
        Of these, whose surroundings are turned as the transform turns.
    """

    a_from_b: Float64Array
    pose: Pose2 | None
    covariance: Float64Array | None
    residuals: Float64Array
    near: BoolArray
    inliers: BoolArray


def check_count(inliers: BoolArray, a: Features, b: Features, options: MatchOptions) -> str:
    """Reject a fit with too few features, matches or inliers, or too small a share of inliers."""
    needed = options.min_inliers
    agree, count = int(inliers.sum()), len(inliers)
    if min(len(a), len(b)) < needed:
        return f"{len(a)} and {len(b)} features; at least {needed} of each are needed"
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


def check_residuals(fit: TransformFit, thresholds: Float64Array, options: MatchOptions) -> str:
    """Reject inliers that lie about the transform as evenly as matches by chance do."""
    ratios = fit.residuals[fit.inliers] / thresholds[fit.inliers]
    relative = float(np.sqrt(np.mean(ratios**2)))
    if relative > options.max_residual_ratio:
        return (
            f"the {len(ratios)} inliers agree no better than by chance: "
            f"rms residual {relative:.2f} of the threshold; at most "
            f"{options.max_residual_ratio:.2f} is accepted"
        )
    return ""


def check_spread(count: int, spread: float, options: MatchOptions) -> str:
    """Reject inliers that cover too little of the view to determine a transform."""
    if spread < options.min_spread:
        return (
            f"the {count} inliers cover {spread:.1%} of the view's extent; "
            f"at least {options.min_spread:.0%} is needed"
        )
    return ""


def check_plausible(a_from_b: Float64Array, points_b: Float64Array, options: MatchOptions) -> str:
    """Reject a transform that no camera over a floor can have made.

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
            f"a scale of {odd:.3g} among the inliers; accepted are "
            f"{1.0 / options.max_scale:.3g} to {options.max_scale:.3g}"
        )
    stretch = float((scales[:, 0] / scales[:, 1]).max())
    if stretch > options.max_stretch:
        return (
            f"a stretch of {stretch:.3g} among the inliers; "
            f"at most {options.max_stretch:.3g} is accepted"
        )
    return ""


def check_unique(fit: TransformFit, pairs: MatchedPoints, options: MatchOptions) -> str:
    """Reject a fit when the matches do not single out one transform.

    Floors that repeat, and lines that look alike, let another motion explain nearly as many of the
    matches that the best one leaves over.
    """
    best, rest = int(fit.inliers.sum()), ~fit.near
    if np.count_nonzero(rest) < options.max_rival_share * best:
        return ""
    rival = ransac(
        pairs.a[rest],
        pairs.b[rest],
        MODELS[options.model],
        pairs.thresholds[rest],
        confidence=options.confidence,
        max_iterations=min(options.max_iterations, _MAX_RIVAL_ITERATIONS),
        seed=options.seed,
    )
    if rival is None:
        return ""
    second = int(rival.inliers.sum())
    if second < options.max_rival_share * best:
        return ""
    apart = apply_homography(rival.a_from_b, pairs.b) - apply_homography(fit.a_from_b, pairs.b)
    limit = _SAME_MOTION_THRESHOLDS * np.median(pairs.thresholds)
    if np.median(np.linalg.norm(apart, axis=1)) < limit:
        return ""
    return f"ambiguous: {best} matches agree on one motion and {second} on another"
