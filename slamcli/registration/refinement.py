"""A motion between two views, refined on their pixels and judged by them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2, wrap_angle
from slamcli.core.records import PyramidLevel
from slamcli.stages import dense

# Two motions nearer than this, in pixels of the coarsest level and in radians, are one.
_SAME_PIXELS = 3.0
_SAME_RADIANS = 0.05
# A rigid motion that correlates so well needs no rocking camera to explain it, unless what is left
# over asks for one. Where it does not, the rocking is believed when it leaves less than the first
# share unexplained: on a floor of a few lines a line's end may be brought to fit by a tilt as well
# as by the motion. Where what is left over asks for it, the second is enough: of noise and of blur
# it explains nothing.
_STEADY_CORRELATION = 0.95
_ROCKING_SHARE, _SUSPECTED_SHARE = 0.6, 0.97
_CONTRAST_HANDICAP = 0.0475
# A robot may rock so much more than its tilt sigma says, where the pixels ask for it.
_ROCKING_TIMES = 5.0
# Of the patches that tell.
_MOSTLY = 0.5
_MAX_STRAY_PIXELS, _MAX_STRAY_RADIANS = 2.0, math.radians(0.5)


@dataclass(frozen=True, slots=True, eq=False)
class PyramidPair:
    """The pyramids of two views of one kind.

    Attributes
    ----------
    a, b : tuple of PyramidLevel
    far : bool
        Whether they reach beyond the range of the features.
    """

    a: tuple[PyramidLevel, ...]
    b: tuple[PyramidLevel, ...]
    far: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MotionHypothesis:
    """A motion that may become a link, and what the pixels say of it.

    Attributes
    ----------
    pose : Pose2
        ``a_from_b``.
    covariance : (3, 3) float64
    agreed : Agreement
    evidence, correlation : float
        Of the contrast-normalised pixels.
    view_a_from_view_b : (3, 3) float64
        The motion as the views show it, each with its frame's tilt.
    rocks : bool
        Whether the pixels ask for a camera that rocks more than this motion allows for.
    """

    pose: Pose2
    covariance: Float64Array
    agreed: dense.Agreement
    evidence: float
    correlation: float
    view_a_from_view_b: Float64Array
    rocks: bool = False

    @property
    def bent(self) -> bool:
        """Whether it takes the camera to have rocked."""
        return not np.array_equal(self.view_a_from_view_b, self.pose.matrix)


def refine_hypothesis(
    pair: PyramidPair,
    pose: Pose2,
    covariance: Float64Array | None,
    calibration: Calibration,
    options: MapperOptions,
) -> MotionHypothesis | None:
    """Refine a motion on the pixels, where that makes them agree better, and judge it.

    Parameters
    ----------
    pair : PyramidPair
    pose : Pose2
    covariance : (3, 3) float64 or None
        As features tell; None for what a search or a guess led to.
    calibration : Calibration
    options : MapperOptions

    Returns
    -------
    MotionHypothesis or None
        None where neither features nor pixels hold the motion.
    """
    if covariance is None:
        return _refined(pair, pose, None, None, calibration, options)
    plain = None
    if options.refine:
        # Features come within a pixel of the finest levels.
        refined = dense.refine(
            pair.a[:2],
            pair.b[:2],
            pose,
            calibration,
            0.0,
            suspected_tilt_radians=math.radians(options.tilt_sigma_degrees),
        )
        if refined is not None:
            plain = score_refined(pair, refined)
            near = not _diverged(pose, plain.pose, pair)
            if near and _explains(plain) and _holds(plain, covariance, calibration, options):
                # As on most floors: there is nothing left to ask the start about.
                return plain
    start = photometric_score(pair, pose, covariance, pose.matrix)
    if not options.refine:
        return start
    return _refined(pair, pose, start, plain, calibration, options)


def _refined(
    pair: PyramidPair,
    pose: Pose2,
    start: MotionHypothesis | None,
    plain: MotionHypothesis | None,
    calibration: Calibration,
    options: MapperOptions,
) -> MotionHypothesis | None:
    """Return the best of a start and its refinements, the camera held still and let rock.

    Parameters
    ----------
    pair : PyramidPair
    pose : Pose2
    start : MotionHypothesis or None
        Of that pose; None when a search or a guess led to it.
    plain : MotionHypothesis or None
        Its refinement with all of the floor and no rocking, if it was made.
    calibration : Calibration
    options : MapperOptions
    """
    levels_a, levels_b, held = _spoken_for(pair, start)
    best, rocked = start, None
    steady = math.radians(options.tilt_sigma_degrees)
    # What lies far off shifts by much for a little tilt, and is never compared without.
    tilts = (0.0, steady, _ROCKING_TIMES * steady)
    for tilt in tilts[1:] if pair.far else tilts:
        # Among bare lines, where no features are, a large tilt passes for a turn.
        asked_for = start is not None or (best is not None and best.bent and best.rocks)
        if (tilt > 0.0 and best is not None and _steady(best)) or (tilt > steady and not asked_for):
            break
        # From where the features or the search led, or less rocking: without the rocking that there
        # is, the refinement may have gone astray.
        fit, refined = plain if tilt == 0.0 and not held else None, None
        if fit is None:
            refined = dense.refine(
                levels_a,
                levels_b,
                pose if rocked is None else rocked.a_from_b,
                calibration,
                tilt,
                searched=start is None,
                rocked=rocked,
                suspected_tilt_radians=steady,
            )
            if refined is None:
                continue
            fit = score_refined(pair, refined)
        if tilt > 0.0 and best is not None and fit.correlation > best.correlation:
            rocked = refined
            if held:
                levels_a = dense.keep_agreeing_points(
                    pair.a[:2], levels_b[0], fit.view_a_from_view_b
                )
        # A camera that rocks makes most of the floor disagree too, until it is allowed for.
        if held and mostly_obstructed(fit) and _diverged(pose, fit.pose, pair):
            continue
        if best is None or (
            _better(fit, best, rocking=tilt > 0.0)
            and _holds(fit, best.covariance, calibration, options)
        ):
            best = fit
            if held and refined is not None and not mostly_obstructed(best):
                # It was the rocking that made the floor disagree: now all of it may speak.
                held, levels_a = False, pair.a[:2]
                best = _by_all_of_the_floor(pair, best, refined, calibration, tilt)
    return best


def _spoken_for(
    pair: PyramidPair, start: MotionHypothesis | None
) -> tuple[tuple[PyramidLevel, ...], tuple[PyramidLevel, ...], bool]:
    """Return the levels that a start is refined on, and whether not all of the floor may speak."""
    if start is None:
        return pair.a, pair.b, False
    levels_a, levels_b = pair.a[:2], pair.b[:2]
    if not mostly_obstructed(start):
        return levels_a, levels_b, False
    # Most of what is seen stands or walks, and would pull the motion to its own.
    return (
        dense.keep_agreeing_points(levels_a, levels_b[0], start.view_a_from_view_b),
        levels_b,
        True,
    )


def _by_all_of_the_floor(
    pair: PyramidPair,
    fit: MotionHypothesis,
    told: dense.PhotometricFit,
    calibration: Calibration,
    tilt_sigma_radians: float,
) -> MotionHypothesis:
    """Refine a motion that the agreeing patches alone told; return the better one."""
    refined = dense.refine(
        pair.a[:2], pair.b[:2], fit.pose, calibration, tilt_sigma_radians, rocked=told
    )
    if refined is None:
        return fit
    whole = score_refined(pair, refined)
    return whole if whole.evidence > fit.evidence else fit


def mostly_obstructed(fit: MotionHypothesis) -> bool:
    """Return whether most of what tells something stands or walks on the floor."""
    return fit.agreed.confirmed < _MOSTLY


def _diverged(start: Pose2, pose: Pose2, pair: PyramidPair) -> bool:
    """Return whether what stands or walks pulled a motion away from what features say."""
    moved = start.inverse() @ pose
    most = _MAX_STRAY_PIXELS * pair.a[0].metres_per_pixel
    return moved.translation_length > most or abs(moved.theta) > _MAX_STRAY_RADIANS


def _holds(
    fit: MotionHypothesis,
    other: Float64Array,
    calibration: Calibration,
    options: MapperOptions,
) -> bool:
    """Return whether the pixels hold a motion in every direction, or no less than another is."""
    least = (options.max_sigma_share * calibration.max_range_metres) ** 2
    return widest_variance(fit) <= max(least, _widest(other))


def widest_variance(fit: MotionHypothesis) -> float:
    """Return the variance of the motion in the direction in which it is known worst."""
    return _widest(fit.covariance)


def _widest(covariance: Float64Array) -> float:
    return float(np.linalg.eigvalsh(covariance[:2, :2])[1])


def converges_to(pair: PyramidPair, guess: Pose2, fit: MotionHypothesis) -> bool:
    """Return whether a guess, refined, would be no other motion than a fit that explains all."""
    return _explains(fit) and same(fit.pose, guess, pair)


def _explains(fit: MotionHypothesis) -> bool:
    """Return whether a fit leaves no camera that rocks and no crowd of legs to be asked about."""
    return _steady(fit) and not mostly_obstructed(fit)


def _steady(fit: MotionHypothesis) -> bool:
    """Return whether no rocking is needed; on a bare floor noise hides it but from the contrast."""
    alike = max(fit.correlation, fit.agreed.correlation - _CONTRAST_HANDICAP)
    return alike >= _STEADY_CORRELATION and not fit.rocks


def refine_on_near_view(
    near: PyramidPair, fit: MotionHypothesis, calibration: Calibration, options: MapperOptions
) -> MotionHypothesis:
    """Refine what the far pixels told on the near ones too, where those share enough of the floor.

    The far pixels' evidence stays: they are what told this motion from others.
    """
    tilt = math.radians(options.tilt_sigma_degrees)
    known = dense.MotionPrior(fit.pose, fit.covariance)
    refined = dense.refine(near.a[:2], near.b[:2], fit.pose, calibration, tilt, known)
    if refined is None:
        return fit
    sharper = score_refined(near, refined)
    if sharper.agreed.overlap < options.min_overlap:
        return fit
    return replace(sharper, evidence=fit.evidence, correlation=fit.correlation)


def photometric_score(
    pair: PyramidPair,
    pose: Pose2,
    covariance: Float64Array,
    shown: Float64Array,
) -> MotionHypothesis:
    """Return what the pixels say of one motion."""
    agreed = dense.agreement(pair.a[0], pair.b[0], shown)
    # The floor's own fine texture outweighs, pixel by pixel, what large things that stand on it do.
    fine = dense.evidence(pair.a[0], pair.b[0], pose, shown)
    middle = dense.evidence(pair.a[1], pair.b[1], pose, shown)
    correlation = max(fine.correlation, middle.correlation)
    return MotionHypothesis(pose, covariance, agreed, fine.evidence, correlation, shown)


def score_refined(pair: PyramidPair, refined: dense.PhotometricFit) -> MotionHypothesis:
    """Return what the pixels say of a refined motion."""
    fit = photometric_score(pair, refined.a_from_b, refined.covariance, refined.view_a_from_view_b)
    return replace(fit, rocks=refined.rocks)


def same(first: Pose2, second: Pose2, pair: PyramidPair) -> bool:
    """Return whether two motions are one, as far as the coarsest level tells."""
    apart = first.inverse() @ second
    near = _SAME_PIXELS * pair.a[-1].metres_per_pixel
    return apart.translation_length < near and abs(wrap_angle(apart.theta)) < _SAME_RADIANS


def _better(fit: MotionHypothesis, other: MotionHypothesis, *, rocking: bool) -> bool:
    """Return whether a refined fit agrees better.

    One that bends the floor must do so by far; where the pixels ask for it, by less; and where
    they ask for more of a bend that is there already, at all.
    """
    if not rocking:
        return fit.evidence > other.evidence
    share = _ROCKING_SHARE
    if other.rocks:
        share = 1.0 if other.bent else _SUSPECTED_SHARE
    return 1.0 - fit.correlation < share * (1.0 - other.correlation)
