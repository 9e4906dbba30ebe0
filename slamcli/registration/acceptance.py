"""Acceptance gates for a measured motion; each returns the reason for rejection, or ""."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import FeatureAlignment
from slamcli.registration import hypotheses
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair


@dataclass(frozen=True, slots=True)
class AcceptanceThresholds:
    """Fixed thresholds of the gates; those that users may set are in `MapperOptions`."""

    # This many times the required inliers count for more than pixels that are dissimilar, or that
    # leave a direction open [guarded by benchmarks/robustness.py: legs and rocking].
    backing_inliers_factor: int = 3
    # Of what a search found: a narrow strip of floor fits elsewhere too, or with another turn
    # [guarded by benchmarks/robustness.py: low-overlap].
    min_searched_overlap: float = 0.2
    # Share of the informative patches that must agree with any fit, and the share that replaces a
    # low correlation: the patches that disagree then show obstacles
    # [guarded by benchmarks/robustness.py: legs].
    min_confirmed: float = 0.35
    min_confirmed_alone: float = 0.5
    # On a bare floor most of the informative patches may show obstacles; where many features back
    # the fit, patches that agree with it are no coincidence
    # [guarded by benchmarks/robustness.py: legs on bare].
    min_confirmed_backed: float = 0.1
    # Where too few patches are informative, the correlation counts only as far as that of the
    # coarsest level, which noise does not lower, or less this
    # [guarded by benchmarks/robustness.py: bare, textureless-course].
    few_patches_handicap: float = 0.4


THRESHOLDS = AcceptanceThresholds()


def convincing(alignment: FeatureAlignment, fit: MotionHypothesis, options: MapperOptions) -> bool:
    """Return whether features and pixels together make a search for another motion needless."""
    return enough_inliers(alignment, options) and (
        fit.agreement.correlation >= options.convincing_score
        or fit.agreement.confirmed >= THRESHOLDS.min_confirmed
    )


def enough_inliers(alignment: FeatureAlignment, options: MapperOptions) -> bool:
    """Return whether enough features agree to be convincing."""
    return alignment.inlier_count >= options.convincing_inliers


def backed_by_features(alignment: FeatureAlignment, options: MapperOptions) -> bool:
    """Return whether enough features agree to back what the pixels show."""
    required = THRESHOLDS.backing_inliers_factor * options.matching.min_inliers
    return alignment.inlier_count >= required


def too_few_inliers(alignment: FeatureAlignment, options: MapperOptions) -> str:
    """Return why features alone are not accepted: too few, or not confirmed by the pixels."""
    count, least = alignment.inlier_count, options.convincing_inliers
    if count >= least:
        return f"the pixels do not confirm the {count} inliers"
    return (
        f"{count} inliers without the pixels' confirmation are too few (of {least}); "
        "leave --dense on, or let frames overlap more"
    )


def max_displacement_metres(first: int, second: int, options: MapperOptions) -> float:
    """Return the farthest that the robot may have moved between two frames, by their indices."""
    step = options.max_step_metres
    return math.inf if step is None else step * max(1, abs(second - first))


def check_plausible(
    fit: MotionHypothesis,
    limit_metres: float,
    options: MapperOptions,
    *,
    beside_features: bool = False,
    backed: bool = False,
) -> str:
    """Return why a fit is not plausible, or contradicted by the pixels.

    Parameters
    ----------
    fit : MotionHypothesis
    limit_metres : float
        The farthest that the robot may have moved.
    options : MapperOptions
    beside_features : bool
        Whether the pixels need only not contradict the features.
    backed : bool
        Whether enough features agree with the fit that few pixels need to.
    """
    return (
        _check_motion(fit, limit_metres, options)
        or _check_overlap(fit, options)
        or _check_patches(fit, backed=backed)
        or _check_correlation(fit, options, beside_features=beside_features, backed=backed)
    )


def _check_motion(fit: MotionHypothesis, limit_metres: float, options: MapperOptions) -> str:
    displacement = fit.pose.translation_length
    if displacement > limit_metres:
        return (
            f"the fit moves the robot by {displacement:.3g}; "
            f"at most {limit_metres:.3g} is plausible"
        )
    turn = abs(math.degrees(fit.pose.theta))
    if turn > options.max_turn_degrees:
        return (
            f"the fit turns the robot by {turn:.0f} degrees; "
            f"at most {options.max_turn_degrees:.0f} are plausible"
        )
    return ""


def _check_overlap(fit: MotionHypothesis, options: MapperOptions) -> str:
    if fit.agreement.overlap < options.min_overlap:
        return (
            f"the fit leaves an overlap of {fit.agreement.overlap:.0%}; "
            f"at least {options.min_overlap:.0%} is needed"
        )
    return ""


def _check_patches(fit: MotionHypothesis, *, backed: bool) -> str:
    least = _min_confirmed(backed=backed)
    if fit.agreement.confirmed < least:
        return (
            f"the views differ: {fit.agreement.confirmed:.0%} of the floor's patches agree with "
            "the best motion; let frames overlap more, or keep obstacles and shadows out of view"
        )
    return ""


def _check_correlation(
    fit: MotionHypothesis, options: MapperOptions, *, beside_features: bool, backed: bool
) -> str:
    enough = THRESHOLDS.min_confirmed_alone
    if backed or beside_features:
        enough = _min_confirmed(backed=backed)
    # Either may be nan, which is not enough.
    if fit.agreement.correlation >= options.min_correlation or fit.agreement.confirmed >= enough:
        return ""
    return (
        f"the pixels disagree with the fit: correlation {fit.agreement.correlation:.2f}; "
        f"at least {options.min_correlation:.2f} is needed"
    )


def check_score(score: float, options: MapperOptions, *, supported: bool = True) -> str:
    """Return why a motion is not accepted that is likely to be wrong.

    Parameters
    ----------
    score : float
    options : MapperOptions
    supported : bool
        Whether features agree with it, or the prior expects it.
    """
    least = options.min_score if supported else max(options.min_score, options.min_score_alone)
    return "" if score >= least else f"the score is {score:.2f}; at least {least:.2f} is needed"


def _min_confirmed(*, backed: bool) -> float:
    return THRESHOLDS.min_confirmed_backed if backed else THRESHOLDS.min_confirmed


def check_similarity(pair: PyramidPair, fit: MotionHypothesis, options: MapperOptions) -> str:
    """Return why the pixels alone are not accepted: too dissimilar, or too little shared floor."""
    correlation = fit.agreement.correlation
    if math.isnan(fit.agreement.confirmed):
        correlation = min(
            correlation,
            max(
                hypotheses.coarse_similarity(pair, fit),
                correlation - THRESHOLDS.few_patches_handicap,
            ),
        )
    confirmed = fit.agreement.confirmed >= THRESHOLDS.min_confirmed_alone
    if not correlation >= options.min_dense_score and not confirmed:
        return (
            f"the views are too dissimilar: correlation {correlation:.2f}; "
            f"at least {options.min_dense_score:.2f} is needed where few features agree"
        )
    if fit.agreement.overlap < THRESHOLDS.min_searched_overlap:
        return (
            f"the views share {fit.agreement.overlap:.0%} of the floor, too little where few "
            f"features agree; let them overlap by {THRESHOLDS.min_searched_overlap:.0%} or more"
        )
    return ""


def check_agrees_with_features(
    alignment: FeatureAlignment, options: MapperOptions, *, contradicts: bool
) -> str:
    """Return why a motion that contradicts the features' is rejected: enough of them agree."""
    if contradicts and enough_inliers(alignment, options):
        return "the pixels support another motion than the features do"
    return ""


def check_unique(rival: float, options: MapperOptions) -> str:
    """Return why a motion is ambiguous, given its rival's share of the evidence."""
    if rival <= options.max_rival_evidence:
        return ""
    return (
        f"ambiguous: another motion explains {rival:.0%} of what the best one does; "
        f"at most {options.max_rival_evidence:.0%} is accepted"
    )


def check_rivals(fit: MotionHypothesis, remaining: MotionHypothesis | None) -> str:
    """Return why a motion is ambiguous, given a rival that nothing rules out."""
    if remaining is None:
        return ""
    apart = (fit.pose.inverse() @ remaining.pose).translation_length
    return f"ambiguous: the floor repeats, and a motion {apart:.2g} farther on fits as well"


def expected_elsewhere(fit: MotionHypothesis, expected: Pose2) -> str:
    """Return why a motion is ambiguous that a pattern may imitate, given the expected one."""
    apart = (fit.pose.inverse() @ expected).translation_length
    return (
        f"ambiguous: the robot is expected {apart:.2g} farther on, "
        "where the views share too little floor to tell"
    )


def surprising(fit: MotionHypothesis, expected: Pose2) -> str:
    """Return why a motion is not accepted that few patches show: another one is expected."""
    apart = (fit.pose.inverse() @ expected).translation_length
    return (
        f"too few patches of the floor show the motion, and the robot is expected {apart:.2g} "
        "farther on"
    )


def check_observable(
    fit: MotionHypothesis, range_metres: float, options: MapperOptions, *, backed: bool = False
) -> str:
    """Return why a motion is not determined in every direction.

    Neither as gradients and noise predict it nor as the residuals show it: along a plain line noise
    passes for some information now and then, but the residuals then show no agreement on it.

    Parameters
    ----------
    fit : MotionHypothesis
    range_metres : float
        How far the camera sees.
    options : MapperOptions
    backed : bool
        Whether enough features agree with the fit that it is no line's: what a camera that rocks
        leaves in the residuals then makes a motion less certain, not open.
    """
    covariances = (
        (fit.predicted_covariance,)
        if backed
        else (
            fit.predicted_covariance,
            fit.covariance,
        )
    )
    reasons = (_check_sigmas(covariance, range_metres, options) for covariance in covariances)
    return next(filter(None, reasons), "")


def _check_sigmas(covariance: Float64Array, range_metres: float, options: MapperOptions) -> str:
    """Return in which direction a (3, 3) covariance leaves a motion open, or ""."""
    variances, directions = np.linalg.eigh(covariance[:2, :2])
    sigma, turn_sigma = math.sqrt(float(variances[1])), math.sqrt(float(covariance[2, 2]))
    if sigma > options.max_sigma_share * range_metres:
        bearing = math.degrees(math.atan2(directions[1, 1], directions[0, 1])) % 180.0
        return (
            f"the motion is open along {bearing:.0f} degrees (one sigma {sigma:.2g}): "
            "both views show nothing but lines in that direction"
        )
    # A turn moves most of the floor by less than half of what it moves the farthest by.
    if turn_sigma > 2.0 * options.max_sigma_share:
        return f"the turn is open (one sigma {math.degrees(turn_sigma):.2g} degrees)"
    return ""
