"""Whether a motion is to be believed; each function returns why not, or nothing."""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.config import MapperOptions
from slamcli.core.records import FeatureAlignment
from slamcli.registration import hypotheses
from slamcli.registration.refinement import MotionHypothesis, PyramidPair

# So many times the inliers that are needed stand in for pixels that look little alike, or that
# leave a direction open.
_BACKING = 3
# A narrow strip of the floor fits elsewhere too, or with another turn.
_MIN_DENSE_OVERLAP = 0.2
# Where so many of the telling patches agree, what disagrees stands on the floor; where features
# without number agree too, as many as must in any case are enough.
_CONFIRMED = 0.5
_MIN_CONFIRMED = 0.35
# On a bare floor most of the patches that tell may show legs; those that agree with what many
# features say are no accident then.
_MIN_BACKED = 0.1
# On a floor with too few patches to vote, the little that there is must agree by so much better
# where the camera's noise hides whether the rest does.
_FEW_PATCHES_HANDICAP = 0.4


def convincing(alignment: FeatureAlignment, fit: MotionHypothesis, options: MapperOptions) -> bool:
    """Return whether features and pixels together leave no reason to look for another motion."""
    return enough_inliers(alignment, options) and (
        fit.agreed.correlation >= options.convincing_score or fit.agreed.confirmed >= _MIN_CONFIRMED
    )


def enough_inliers(alignment: FeatureAlignment, options: MapperOptions) -> bool:
    """Return whether so many features agree that they could convince."""
    return alignment.inlier_count >= options.convincing_inliers


def backed_by_features(alignment: FeatureAlignment, options: MapperOptions) -> bool:
    """Return whether enough features agree to back what the pixels say."""
    return alignment.inlier_count >= _BACKING * options.matching.min_inliers


def too_few_inliers(alignment: FeatureAlignment, options: MapperOptions) -> str:
    """Return why features alone are not believed."""
    return (
        f"{alignment.inlier_count} inliers do not convince; "
        f"{options.convincing_inliers} do where the pixels agree"
    )


def max_displacement_metres(first: int, second: int, options: MapperOptions) -> float:
    """Return the farthest that the robot may have gone between two frames, by their indices."""
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
    most_metres : float
        The farthest that the robot may have gone.
    beside_features : bool
        Whether the pixels are asked for no more than not to contradict the features.
    backed : bool
        Whether so many features agree with the fit that few pixels need to.
    """
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
    if fit.agreed.overlap < options.min_overlap:
        return (
            f"the fit leaves an overlap of {fit.agreed.overlap:.0%}; "
            f"at least {options.min_overlap:.0%} is needed"
        )
    least = _MIN_BACKED if backed else _MIN_CONFIRMED
    if fit.agreed.confirmed < least:
        return (
            f"only {fit.agreed.confirmed:.0%} of the floor's patches agree with the fit; "
            f"at least {least:.0%} must"
        )
    enough = least if backed or beside_features else _CONFIRMED
    if not fit.agreed.correlation >= options.min_score and not fit.agreed.confirmed >= enough:
        return (
            f"the pixels disagree with the fit: correlation {fit.agreed.correlation:.2f}; "
            f"at least {options.min_score:.2f} is needed"
        )
    return ""


def check_similarity(pair: PyramidPair, fit: MotionHypothesis, options: MapperOptions) -> str:
    """Return why the pixels alone are not believed: too unlike, or of too little shared floor."""
    alike = fit.agreed.correlation
    if math.isnan(fit.agreed.confirmed):
        alike = min(
            alike, max(hypotheses.coarse_similarity(pair, fit), alike - _FEW_PATCHES_HANDICAP)
        )
    if not alike >= options.min_dense_score and not fit.agreed.confirmed >= _CONFIRMED:
        return (
            f"the pixels are too unlike: correlation {alike:.2f}; "
            f"at least {options.min_dense_score:.2f} is needed"
        )
    if fit.agreed.overlap < _MIN_DENSE_OVERLAP:
        return (
            f"the pixels share {fit.agreed.overlap:.0%} of the floor; "
            f"at least {_MIN_DENSE_OVERLAP:.0%} is needed where few features agree"
        )
    return ""


def check_unique(rival: float, options: MapperOptions) -> str:
    """Return why a motion is not singled out, given its rival's share of the evidence."""
    if rival <= options.max_rival_evidence:
        return ""
    return (
        f"ambiguous: another motion explains {rival:.0%} of what the best one does; "
        f"at most {options.max_rival_evidence:.0%} is believed"
    )


def check_period(
    fit: MotionHypothesis, like: list[MotionHypothesis], options: MapperOptions
) -> str:
    """Return why a motion is not singled out on a floor that repeats, given those it is like."""
    for other in like:
        if other.evidence > options.max_rival_evidence * fit.evidence:
            apart = (fit.pose.inverse() @ other.pose).translation_length
            return f"ambiguous: the floor repeats, and {apart:.2g} farther on it fits as well"
    return ""


def check_observable(fit: MotionHypothesis, range_metres: float, options: MapperOptions) -> str:
    """Return why a motion is not known in every direction."""
    variances, directions = np.linalg.eigh(fit.covariance[:2, :2])
    sigma, turn_sigma = math.sqrt(float(variances[1])), math.sqrt(float(fit.covariance[2, 2]))
    if sigma <= options.max_sigma_share * range_metres:
        # A turn moves most of the floor by less than half of what it moves the farthest by.
        if turn_sigma <= 2.0 * options.max_sigma_share:
            return ""
        return f"the pixels leave the turn open (one sigma {math.degrees(turn_sigma):.2g} degrees)"
    bearing = math.degrees(math.atan2(directions[1, 1], directions[0, 1])) % 180.0
    return (
        f"the pixels leave the motion open along {bearing:.0f} degrees "
        f"(one sigma {sigma:.2g}): lines alone do not tell how far along them the robot went"
    )
