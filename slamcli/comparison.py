"""One frame against one keyframe: what fits, and whether the pixels let it be believed.

Features come first. When they are few, badly spread, or the pixels do not confirm their fit, every
motion within reach is searched on the pixels themselves, and one is believed when it explains them
clearly better than any other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import wrap_angle
from slamcli.core.records import Link
from slamcli.stages import align, dense

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.config import MapperOptions
    from slamcli.core.geometry import Pose2
    from slamcli.core.records import Alignment, Calibration, Prepared

# How far from a guess matches are looked for, as a share of how far the camera sees.
_SEARCH_SHARE_OF_RANGE = 0.1
# So many peaks of a search are followed up; a ridge along a line alone may hold several.
_PEAKS = 10
# What explains less than this share of what the best peak does, on the coarsest level, is no rival
# on finer ones either.
_LEAST_SHARE_OF_BEST = 0.4
# Two motions nearer than this, in pixels of the coarsest level and in radians, are one.
_SAME_PIXELS = 3.0
_SAME_RADIANS = 0.05
# Fits of one motion with about the same evidence differ in what they let the camera do besides.
_EQUAL_SHARE = 0.95
# A rigid motion that correlates so well needs no rocking camera to explain it; where it does not,
# the rocking is believed when it leaves less than this share unexplained. On a floor of a few lines
# a line's end may be brought to fit by a tilt as well as by the motion.
_STEADY_CORRELATION = 0.95
_ROCKING_SHARE = 0.6
# A robot may rock so much more than its tilt sigma says, where the pixels ask for it.
_ROCKING_TIMES = 5.0
# So many times the inliers that are needed stand in for pixels that look little alike, or that
# leave a direction open.
_BACKING = 3
# A narrow strip of the floor fits elsewhere too, or with another turn.
_LEAST_DENSE_OVERLAP = 0.2
# Where so many of the telling patches agree, what disagrees stands on the floor; where features
# without number agree too, few patches are enough.
_CONFIRMED = 0.5
_LEAST_CONFIRMED = 0.35
_CONFIRMED_BESIDE_FEATURES = 0.2
# By so much more must views be alike on the coarsest level, whose few pixels agree by chance.
_COARSE_HANDICAP = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One comparison of a frame with a keyframe: what fits, or why nothing does.

    Attributes
    ----------
    keyframe, prepared : Prepared
    alignment : Alignment
        What the features said.
    link : Link or None
    overlap : float
        Share of the smaller view's floor that both see; 0 when nothing gave a fit.
    reason : str
        Why there is no link; empty when there is one.
    rival : float
        Evidence of the next best motion over that of the best, in [0, 1]; nan when the features
        alone decided.
    search : Search or None
        What the pixels were asked, when they were.
    """

    keyframe: Prepared
    prepared: Prepared
    alignment: Alignment
    link: Link | None
    overlap: float = 0.0
    reason: str = ""
    rival: float = math.nan
    search: dense.Search | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A motion that may become a link, and what the pixels say of it."""

    pose: Pose2
    covariance: NDArray[np.float64] | None
    agreed: dense.Agreement
    evidence: float
    correlation: float
    view_a_from_view_b: NDArray[np.float64]


def compare(
    keyframe: Prepared,
    prepared: Prepared,
    guess: Pose2 | None,
    calibration: Calibration,
    options: MapperOptions,
    *,
    window: dense.Window | None = None,
) -> Trial:
    """Align a frame to a keyframe and check the fit by the pixels before it is believed.

    Parameters
    ----------
    keyframe, prepared : Prepared
        Both with features and levels.
    guess : Pose2 or None
        ``keyframe_from_prepared`` as expected; matches are looked for near it alone.
    window : Window or None
        Where the pixels are searched when the features do not convince; nowhere when it is None.
        Given a guess they are asked about that alone.
    """
    assert keyframe.features is not None
    assert prepared.features is not None
    matching = replace(
        options.matching,
        model="rigid",
        search_radius=_SEARCH_SHARE_OF_RANGE * calibration.max_range_metres,
    )
    alignment = align.align(keyframe.features, prepared.features, matching, guess)
    by_features = None
    if alignment.pose is not None and alignment.covariance is not None and not alignment.reason:
        by_features = _polish(
            keyframe, prepared, alignment.pose, alignment.covariance, calibration, options
        )
        if not options.dense or _convincing(alignment, by_features, options):
            needed = _CONFIRMED_BESIDE_FEATURES if options.dense else _CONFIRMED
            doubt = _doubt(by_features, options, needed)
            return _trial(keyframe, prepared, alignment, by_features, doubt)
    if not options.dense or (window is None and guess is None):
        doubt = alignment.reason or (
            f"{alignment.inlier_count} inliers do not convince; "
            f"{options.convincing_inliers} do where the pixels agree"
        )
        return _trial(keyframe, prepared, alignment, by_features, doubt)
    starts, found = [guess] if guess is not None else [], None
    if guess is None and window is not None:
        coarsest = keyframe.levels[-1], prepared.levels[-1]
        found = dense.search(*coarsest, window, min_overlap=options.min_overlap, count=_PEAKS)
        starts = _follow_up(keyframe, prepared, found, calibration, options)
    # A start that the refinement leaves far behind is a slope of the evidence, not a peak.
    polished = [_polish(keyframe, prepared, start, None, calibration, options) for start in starts]
    fits = [fit for fit in polished if fit.covariance is not None]
    if by_features is not None:
        fits.append(by_features)
    reach = calibration.max_range_metres
    return _choose(keyframe, prepared, alignment, fits, by_features, found, reach, options)


def _choose(
    keyframe: Prepared,
    prepared: Prepared,
    alignment: Alignment,
    fits: list[_Fit],
    by_features: _Fit | None,
    found: dense.Search | None,
    range_metres: float,
    options: MapperOptions,
) -> Trial:
    """Believe the motion that explains the pixels best, if it does so well and alone."""
    fits = _distinct(sorted(fits, key=lambda fit: -fit.evidence), keyframe)
    if not fits:
        reason = alignment.reason or "the pixels show no motion"
        return _trial(keyframe, prepared, alignment, None, reason, 1.0, found)
    best = fits[0]
    rival = fits[1].evidence / best.evidence if len(fits) > 1 and best.evidence > 0 else 0.0
    doubt = _doubt(best, options)
    alike = best.agreed.correlation
    if math.isnan(best.agreed.confirmed):
        alike = min(alike, _likeness(keyframe, prepared, best))
    enough = alignment.inlier_count >= _BACKING * options.matching.min_inliers
    backed = enough and by_features is not None and _same(by_features.pose, best.pose, keyframe)
    if not doubt and not backed and not alike >= options.min_dense_score:
        doubt = (
            f"the pixels are too unlike: correlation {alike:.2f}; "
            f"at least {options.min_dense_score:.2f} is needed"
        )
    many = alignment.inlier_count >= options.convincing_inliers
    if (
        not doubt
        and many
        and by_features is not None
        and not _same(by_features.pose, best.pose, keyframe)
    ):
        doubt = "the pixels speak for another motion than the features do"
    if not doubt and rival > options.max_rival_evidence:
        doubt = (
            f"ambiguous: another motion explains {rival:.0%} of what the best one does; "
            f"at most {options.max_rival_evidence:.0%} is believed"
        )
    if not doubt and not backed and best.agreed.overlap < _LEAST_DENSE_OVERLAP:
        doubt = (
            f"the pixels share {best.agreed.overlap:.0%} of the floor; "
            f"at least {_LEAST_DENSE_OVERLAP:.0%} is needed where few features agree"
        )
    if not doubt and not backed:
        doubt = _undetermined(best, range_metres, options)
    return _trial(keyframe, prepared, alignment, best, doubt, rival, found)


def _likeness(keyframe: Prepared, prepared: Prepared, fit: _Fit) -> float:
    """Return how like the views are: on a bare floor the camera's noise hides it but coarsely."""
    coarsest = keyframe.levels[-1], prepared.levels[-1]
    coarse = dense.evidence(*coarsest, fit.pose, fit.view_a_from_view_b).correlation
    return max(fit.correlation, coarse - _COARSE_HANDICAP)


def _undetermined(fit: _Fit, range_metres: float, options: MapperOptions) -> str:
    """Return why a motion is not known in every direction, or nothing."""
    if fit.covariance is None:
        return "the pixels do not determine the motion"
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


def _follow_up(
    keyframe: Prepared,
    prepared: Prepared,
    found: dense.Search,
    calibration: Calibration,
    options: MapperOptions,
) -> list[Pose2]:
    """Refine a search's peaks on its own level; return those that may be the best or its rival."""
    tilt = math.radians(options.tilt_sigma_degrees)
    coarse_a, coarse_b = keyframe.levels[-1:], prepared.levels[-1:]
    peaks: list[dense.Candidate] = []
    for peak in found.candidates:
        if peak.evidence < _LEAST_SHARE_OF_BEST * found.candidates[0].evidence:
            continue
        refined = dense.refine(coarse_a, coarse_b, peak.a_from_b, calibration, tilt)
        pose, shown = peak.a_from_b, peak.a_from_b.matrix
        if refined is not None:
            pose, shown = refined.a_from_b, refined.view_a_from_view_b
        if not any(_same(other.a_from_b, pose, keyframe) for other in peaks):
            peaks.append(dense.evidence(coarse_a[0], coarse_b[0], pose, shown))
    peaks.sort(key=lambda peak: -peak.evidence)
    kept = [p for p in peaks if p.evidence >= _LEAST_SHARE_OF_BEST * peaks[0].evidence]
    return [peak.a_from_b for peak in kept[: options.most_hypotheses]]


def _polish(
    keyframe: Prepared,
    prepared: Prepared,
    pose: Pose2,
    covariance: NDArray[np.float64] | None,
    calibration: Calibration,
    options: MapperOptions,
) -> _Fit:
    """Refine a motion on the pixels, where that makes them agree better, and judge it."""
    start = _judge(keyframe, prepared, pose, covariance, pose.matrix)
    if not options.refine and covariance is not None:
        return start
    # Features come within a pixel of the finest levels; what a search found starts at the coarsest.
    levels = slice(0, 2) if covariance is not None else slice(None)
    pair = keyframe.levels[levels], prepared.levels[levels]
    best = start
    steady = math.radians(options.tilt_sigma_degrees)
    # Among bare lines, where no features are, a large tilt passes for a turn.
    tilts = (0.0, steady) if covariance is None else (0.0, steady, _ROCKING_TIMES * steady)
    for tilt in tilts:
        if best.covariance is not None and best.correlation >= _STEADY_CORRELATION:
            break
        refined = dense.refine(*pair, best.pose, calibration, tilt)
        if refined is None:
            break
        fit = _judge(
            keyframe,
            prepared,
            refined.a_from_b,
            refined.covariance,
            refined.view_a_from_view_b,
        )
        if best.covariance is None or _better(fit, best, rocking=tilt > 0.0):
            best = fit
    return best


def _judge(
    keyframe: Prepared,
    prepared: Prepared,
    pose: Pose2,
    covariance: NDArray[np.float64] | None,
    shown: NDArray[np.float64],
) -> _Fit:
    agreed = dense.agreement(keyframe.levels[0], prepared.levels[0], shown)
    # The floor's own fine texture outweighs, pixel by pixel, what large things that stand on it do.
    fine = dense.evidence(keyframe.levels[0], prepared.levels[0], pose, shown)
    middle = dense.evidence(keyframe.levels[1], prepared.levels[1], pose, shown)
    correlation = max(fine.correlation, middle.correlation)
    return _Fit(pose, covariance, agreed, fine.evidence, correlation, shown)


def _better(fit: _Fit, other: _Fit, *, rocking: bool) -> bool:
    """Return whether a refined fit agrees better; one that bends the floor must do so by far."""
    if not rocking:
        return fit.evidence > other.evidence
    return 1.0 - fit.correlation < _ROCKING_SHARE * (1.0 - other.correlation)


def _convincing(alignment: Alignment, fit: _Fit, options: MapperOptions) -> bool:
    """Return whether features and pixels together leave no reason to look for another motion."""
    return alignment.inlier_count >= options.convincing_inliers and (
        fit.agreed.correlation >= options.convincing_score
        or fit.agreed.confirmed >= _CONFIRMED_BESIDE_FEATURES
    )


def _distinct(fits: list[_Fit], keyframe: Prepared) -> list[_Fit]:
    """Return the fits, best first, each motion once: as it is known best among equals."""
    kept: list[_Fit] = []
    for fit in fits:
        place = next((n for n, k in enumerate(kept) if _same(k.pose, fit.pose, keyframe)), None)
        if place is None:
            kept.append(fit)
        elif fit.evidence > _EQUAL_SHARE * kept[place].evidence and _surer(fit, kept[place]):
            kept[place] = fit
    return kept


def _surer(fit: _Fit, other: _Fit) -> bool:
    assert fit.covariance is not None
    assert other.covariance is not None
    return bool(np.linalg.det(fit.covariance) < np.linalg.det(other.covariance))


def _same(first: Pose2, second: Pose2, keyframe: Prepared) -> bool:
    apart = first.inverse() @ second
    near = _SAME_PIXELS * keyframe.levels[-1].metres_per_pixel
    return apart.translation_length < near and abs(wrap_angle(apart.theta)) < _SAME_RADIANS


def _trial(
    keyframe: Prepared,
    prepared: Prepared,
    alignment: Alignment,
    fit: _Fit | None,
    doubt: str,
    rival: float = math.nan,
    found: dense.Search | None = None,
) -> Trial:
    """Return the trial of a fit: with its link, or with why there is none."""
    link = None
    if fit is not None and fit.covariance is not None and not doubt:
        link = Link(
            keyframe.index,
            prepared.index,
            fit.pose,
            fit.covariance,
            alignment.inlier_count if math.isnan(rival) else 0,
            fit.agreed.correlation,
            "step",
        )
    overlap = 0.0 if fit is None else fit.agreed.overlap
    reason = "" if link is not None else f"{doubt} (to {keyframe.name})"
    return Trial(keyframe, prepared, alignment, link, overlap, reason, rival, found)


def _doubt(fit: _Fit, options: MapperOptions, confirmed: float = _CONFIRMED) -> str:
    """Return why a fit is not plausible, or contradicted by the pixels; empty when neither."""
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
    if fit.agreed.confirmed < _LEAST_CONFIRMED:
        return (
            f"only {fit.agreed.confirmed:.0%} of the floor's patches agree with the fit; "
            f"at least {_LEAST_CONFIRMED:.0%} must"
        )
    if not fit.agreed.correlation >= options.min_score and not fit.agreed.confirmed >= confirmed:
        return (
            f"the pixels disagree with the fit: correlation {fit.agreed.correlation:.2f}; "
            f"at least {options.min_score:.2f} is needed"
        )
    return ""
