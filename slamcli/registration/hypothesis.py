"""A motion hypothesis: a candidate motion between two views, scored by their pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2, wrap_angle
from slamcli.core.records import PyramidLevel
from slamcli.stages import dense

# Two motions nearer than this, in pixels of the coarsest level and in radians, are the same one:
# less than what separates two peaks of a search [guarded by benchmarks/robustness.py].
_SAME_PIXELS = 3.0
_SAME_RADIANS = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class PyramidPair:
    """The image pyramids of two views, both near or both far.

    Attributes
    ----------
    a, b : tuple of PyramidLevel
        From fine to coarse.
    far : bool
        Whether they reach beyond the range of the features.
    """

    a: tuple[PyramidLevel, ...]
    b: tuple[PyramidLevel, ...]
    far: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MotionHypothesis:
    """A candidate motion, and how well the pixels of both views agree with it.

    Attributes
    ----------
    pose : Pose2
        ``a_from_b``.
    covariance : (3, 3) float64
        Of x, y (m), theta (rad), in b's own axes.
    predicted_covariance : (3, 3) float64
        Likewise, on the safe side: for whether the motion is determined.
    agreement : Agreement
        Of the gray values at the finest level.
    evidence : float
        Log-likelihood ratio of the contrast-normalised pixels at the finest level.
    correlation : float
        Of the contrast-normalised pixels: the higher of the two finest levels', in [-1, 1].
    view_a_from_view_b : (3, 3) float64
        Metres to metres: the motion as the views show it, each with its frame's rocking.
    rocking_suspected : bool
        Whether the residuals suggest that the camera rocked more than this motion allows for.
    tilt_radians : float
        The largest tilt of either frame's camera, off the calibration's, that the motion includes.
    """

    pose: Pose2
    covariance: Float64Array
    predicted_covariance: Float64Array
    agreement: dense.Agreement
    evidence: float
    correlation: float
    view_a_from_view_b: Float64Array
    rocking_suspected: bool = False
    tilt_radians: float = 0.0

    @property
    def includes_rocking(self) -> bool:
        """Whether the views are related by more than the rigid motion: the camera rocked."""
        return not np.array_equal(self.view_a_from_view_b, self.pose.matrix)

    @property
    def max_variance(self) -> float:
        """Variance of the translation along its least certain direction, square metres."""
        return max_variance(self.predicted_covariance)


def max_variance(covariance: Float64Array) -> float:
    """Return the variance along the least certain direction of a (3, 3) pose covariance."""
    return float(np.linalg.eigvalsh(covariance[:2, :2])[1])


def photometric_score(
    pair: PyramidPair,
    pose: Pose2,
    covariance: Float64Array,
    view_a_from_view_b: Float64Array,
) -> MotionHypothesis:
    """Return a motion with its photometric scores."""
    agreement = dense.agreement(pair.a[0], pair.b[0], view_a_from_view_b)
    # Normalised contrast: the floor's fine texture covers more pixels than large obstacles do.
    fine = dense.evidence(pair.a[0], pair.b[0], pose, view_a_from_view_b)
    middle = dense.evidence(pair.a[1], pair.b[1], pose, view_a_from_view_b)
    correlation = max(fine.correlation, middle.correlation)
    return MotionHypothesis(
        pose, covariance, covariance, agreement, fine.evidence, correlation, view_a_from_view_b
    )


def score_refined(pair: PyramidPair, refined: dense.PhotometricFit) -> MotionHypothesis:
    """Return a refined motion with its photometric scores."""
    scored = photometric_score(
        pair, refined.a_from_b, refined.covariance, refined.view_a_from_view_b
    )
    tilts = [0.0, *np.abs(refined.mounting_a[:2]), *np.abs(refined.mounting_b[:2])]
    return replace(
        scored,
        predicted_covariance=refined.predicted_covariance,
        rocking_suspected=refined.rocking_suspected,
        tilt_radians=float(max(tilts)),
    )


def score_coarsely(pair: PyramidPair, refined: dense.PhotometricFit) -> MotionHypothesis:
    """Return a refined motion scored as by `score_refined`, its evidence that of the second level.

    Where there is no rival that its evidence would be compared with; else `score_finely` follows.
    """
    return with_evidence(score_agreement(pair.a[0], pair.b[0], refined), pair.a[1], pair.b[1])


def score_agreement(
    a: PyramidLevel, b: PyramidLevel, refined: dense.PhotometricFit
) -> MotionHypothesis:
    """Return a refined motion with the agreement of its gray values on one level, no evidence."""
    return MotionHypothesis(
        refined.a_from_b,
        refined.covariance,
        refined.predicted_covariance,
        dense.agreement(a, b, refined.view_a_from_view_b),
        0.0,
        -1.0,
        refined.view_a_from_view_b,
        refined.rocking_suspected,
    )


def with_evidence(fit: MotionHypothesis, a: PyramidLevel, b: PyramidLevel) -> MotionHypothesis:
    """Return a motion with its evidence on one level."""
    middle = dense.evidence(a, b, fit.pose, fit.view_a_from_view_b)
    return replace(fit, evidence=middle.evidence, correlation=middle.correlation)


def score_finely(pair: PyramidPair, fit: MotionHypothesis) -> MotionHypothesis:
    """Return a motion that `score_coarsely` returned as if by `score_refined`."""
    fine = dense.evidence(pair.a[0], pair.b[0], fit.pose, fit.view_a_from_view_b)
    correlation = max(fine.correlation, fit.correlation)
    return replace(fit, evidence=fine.evidence, correlation=correlation)


def same_motion(first: Pose2, second: Pose2, pair: PyramidPair) -> bool:
    """Return whether two motions are the same at the resolution of the coarsest level."""
    apart = first.inverse() @ second
    limit_metres = _SAME_PIXELS * pair.a[-1].metres_per_pixel
    near = apart.translation_length < limit_metres
    return near and abs(wrap_angle(apart.theta)) < _SAME_RADIANS
