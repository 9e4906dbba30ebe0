"""Registration of a frame against a keyframe: its motion, or why none is accepted.

1. Features: their motion is refined on the pixels and accepted when it is convincing.
2. Pixels: otherwise the motion is refined near a guess, or every motion within a window is
   searched, and one is accepted when it explains the pixels clearly better than any other.
3. Far view: where the near floor is bare, plain or hardly shared, the search is repeated beyond
   the range of the features, where the view is smeared.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions, MatchOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import PreparedFrame
from slamcli.registration import acceptance, hypotheses, refinement
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.registration.result import INCONCLUSIVE, RegistrationResult, Verdict
from slamcli.registration.selection import PairContext
from slamcli.stages import align, dense

__all__ = [
    "RegistrationResult",
    "count_features",
    "register",
    "register_where_features_agree",
]

# How far from a guess matches are looked for, as a share of how far the camera sees
# [guarded by benchmarks/robustness.py: plain chains lose tiles to matches from afar].
_MATCH_RADIUS_SHARE_OF_RANGE = 0.1


def register(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    guess: Pose2 | None,
    calibration: Calibration,
    options: MapperOptions,
    *,
    window: dense.SearchWindow | None = None,
    prior: dense.MotionPrior | None = None,
) -> RegistrationResult:
    """Align a frame to a keyframe, and accept the motion if features and pixels support it.

    Parameters
    ----------
    keyframe, prepared : PreparedFrame
        Both with features and levels.
    guess : Pose2 or None
        ``keyframe_from_prepared`` as expected; matches are looked for only near it, and the pixels
        are refined from it.
    calibration : Calibration
    options : MapperOptions
    window : SearchWindow or None
        Given no guess: where the pixels are searched when the features are not convincing; None
        searches nowhere.
    prior : MotionPrior or None
        What odometry, the motion model or the map's poses say of the motion. It chooses among
        motions that the pixels support alike; given no guess, matches are looked for first where it
        expects them, which is much less work.
    """
    near = PyramidPair(keyframe.levels, prepared.levels)
    searched_metres = 0.0 if window is None or guess is not None else window.radius_metres
    make = partial(_match, keyframe, prepared, calibration, options, searched_metres, prior)
    if prior is not None and guess is None and not _floor_repeats(prepared):
        context = make(prior.a_from_b)
        if (result := _accept_many_features(context, near)) is not None:
            return result
    return _register_matched(make(guess), near, guess, window)


def register_where_features_agree(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    guess: Pose2,
    calibration: Calibration,
    options: MapperOptions,
    min_inliers: int,
    prior: dense.MotionPrior | None = None,
) -> RegistrationResult | None:
    """Return what `register` does near a guess; None where fewer features agree with a motion.

    Where features must agree anyhow, the pixels need not be refined without them.
    """
    context = _match(keyframe, prepared, calibration, options, 0.0, prior, guess)
    if not context.alignment.accepted or context.alignment.inlier_count < min_inliers:
        return None
    near = PyramidPair(keyframe.levels, prepared.levels)
    return _register_matched(context, near, guess, None)


def count_features(
    result: RegistrationResult, calibration: Calibration, options: MapperOptions
) -> int:
    """Return how many features agree with the motion that a direct tracking measured."""
    keyframe, prepared = result.keyframe.features, result.prepared.features
    if result.link is None or keyframe is None or prepared is None:
        return 0
    matching = _matching(calibration, options)
    return align.count_agreeing(keyframe, prepared, matching, result.link.a_from_b)


def _register_matched(
    context: PairContext,
    near: PyramidPair,
    guess: Pose2 | None,
    window: dense.SearchWindow | None,
) -> RegistrationResult:
    """Return the result of matched frames, by features and pixels."""
    if not context.options.dense or (window is None and guess is None):
        return _register_by_features(context, near)
    by_features = _refine_features(context, near)
    verdict = _verdict_on_features(context, near, by_features)
    if verdict.outcome == "accepted":
        return context.result(by_features, verdict)
    by_features = _within_reach(context, by_features)
    if guess is not None:
        return _register_near_guess(context, near, by_features, guess)
    assert window is not None
    return _register_in_window(context, near, by_features, window)


def _match(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    calibration: Calibration,
    options: MapperOptions,
    searched_metres: float,
    prior: dense.MotionPrior | None,
    guess: Pose2 | None,
) -> PairContext:
    """Return two frames with the alignment of their features, near a guess if there is one."""
    assert keyframe.features is not None
    assert prepared.features is not None
    matching = _matching(calibration, options)
    alignment = align.align(keyframe.features, prepared.features, matching, guess)
    return PairContext(keyframe, prepared, alignment, calibration, options, searched_metres, prior)


def _matching(calibration: Calibration, options: MapperOptions) -> MatchOptions:
    radius = _MATCH_RADIUS_SHARE_OF_RANGE * calibration.max_range_metres
    return replace(options.matching, model="rigid", search_radius=radius)


def _floor_repeats(prepared: PreparedFrame) -> bool:
    return len(prepared.repeats) > 0


def _refine_features(context: PairContext, near: PyramidPair) -> MotionHypothesis | None:
    """Return the features' motion refined on the pixels; None when they determine none."""
    alignment = context.alignment
    if alignment.pose is None or alignment.covariance is None or alignment.reason:
        return None
    return refinement.refine_hypothesis(
        near, alignment.pose, alignment.covariance, context.calibration, context.options
    )


def _verdict_on_features(
    context: PairContext, near: PyramidPair, fit: MotionHypothesis | None
) -> Verdict:
    """Return the verdict on the features' motion: inconclusive where they are not convincing."""
    options = context.options
    if fit is None:
        return INCONCLUSIVE
    if options.dense and not acceptance.convincing(context.alignment, fit, options):
        return INCONCLUSIVE
    return Verdict.of(
        acceptance.check_plausible(
            fit, context.max_displacement_metres, options, beside_features=options.dense
        )
        or context.check_rivals(near, fit)
    )


def _within_reach(context: PairContext, fit: MotionHypothesis | None) -> MotionHypothesis | None:
    """Return the features' motion unless it is farther than the robot may have moved."""
    if fit is None or fit.pose.translation_length > context.max_displacement_metres:
        return None
    return fit


def _accept_many_features(context: PairContext, near: PyramidPair) -> RegistrationResult | None:
    """Return the result of a motion that many features support; None where it is not accepted."""
    if not acceptance.enough_inliers(context.alignment, context.options):
        return None
    fit = _refine_features(context, near)
    verdict = _verdict_on_features(context, near, fit)
    return context.result(fit, verdict) if verdict.outcome == "accepted" else None


def _register_by_features(context: PairContext, near: PyramidPair) -> RegistrationResult:
    """Return the result of the features' motion, without a search of the pixels."""
    alignment, options = context.alignment, context.options
    too_few = Verdict.of(alignment.reason or acceptance.too_few_inliers(alignment, options))
    if options.dense and not acceptance.enough_inliers(alignment, options):
        return context.result(None, too_few)
    fit = _refine_features(context, near)
    verdict = _verdict_on_features(context, near, fit)
    if verdict.outcome == "inconclusive":
        return context.result(_within_reach(context, fit), too_few)
    return context.result(fit, verdict)


def _register_near_guess(
    context: PairContext,
    near: PyramidPair,
    by_features: MotionHypothesis | None,
    guess: Pose2,
) -> RegistrationResult:
    """Return the result of the guess refined on the pixels, or of the features' motion."""
    fits: list[MotionHypothesis] = []
    if by_features is None or not refinement.converges_to(near, guess, by_features):
        fits = _refine_guess(context, near, guess)
    return context.choose(near, fits, by_features, None)


def _refine_guess(context: PairContext, near: PyramidPair, guess: Pose2) -> list[MotionHypothesis]:
    """Return a guess refined on all levels and, where that explains less than all, on the finest.

    Of few lines the coarse levels show too little to start on.
    """
    fits = []
    for pair in (near, PyramidPair(near.a[:2], near.b[:2])):
        fit = refinement.refine_hypothesis(pair, guess, None, context.calibration, context.options)
        fits += [] if fit is None else [fit]
        if fit is not None and refinement.converges_to(near, guess, fit):
            break
    return fits


def _register_in_window(
    context: PairContext,
    near: PyramidPair,
    by_features: MotionHypothesis | None,
    window: dense.SearchWindow,
) -> RegistrationResult:
    """Return the result of a search of the near pixels or, where that gives no link, the far."""
    keyframe, prepared = context.keyframe, context.prepared
    window = replace(window, max_displacement_metres=context.max_displacement_metres)
    found, fits = hypotheses.search(near, window, context.calibration, context.options)
    result = context.choose(near, fits, by_features, found)
    if result.link is not None or not (keyframe.far_levels and prepared.far_levels):
        return result
    far = PyramidPair(keyframe.far_levels, prepared.far_levels, far=True)
    _, far_fits = hypotheses.search(far, window, context.calibration, context.options)
    fits = [
        refinement.refine_on_near_view(near, fit, context.calibration, context.options)
        for fit in far_fits
    ]
    far_result = context.choose(far, fits, None, found)
    return result if far_result.link is None else far_result
