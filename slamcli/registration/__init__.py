"""One frame against one keyframe: what fits, and whether the pixels let it be believed.

Features come first. When they are few, badly spread, or the pixels do not confirm their fit, every
motion within reach is searched on the pixels themselves, and one is believed when it explains them
clearly better than any other. What lies beyond the range of the features, smeared as it is, is
asked last: it holds the motion where the near floor is bare, plain or hardly shared.
"""

from __future__ import annotations

from dataclasses import replace

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import PreparedFrame
from slamcli.registration import acceptance, hypotheses, refinement
from slamcli.registration.refinement import MotionHypothesis, PyramidPair
from slamcli.registration.selection import PairContext, RegistrationResult
from slamcli.stages import align, dense

__all__ = ["RegistrationResult", "compare"]

# How far from a guess matches are looked for, as a share of how far the camera sees.
_SEARCH_SHARE_OF_RANGE = 0.1


def register(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    guess: Pose2 | None,
    calibration: Calibration,
    options: MapperOptions,
    *,
    window: dense.SearchWindow | None = None,
    expected: Pose2 | None = None,
) -> RegistrationResult:
    """Align a frame to a keyframe and check the fit by the pixels before it is believed.

    Parameters
    ----------
    keyframe, prepared : PreparedFrame
        Both with features and levels.
    guess : Pose2 or None
        ``keyframe_from_prepared`` as expected; matches are looked for near it alone.
    window : SearchWindow or None
        Where the pixels are searched when the features do not convince; nowhere when it is None.
        Given a guess they are asked about that alone.
    expected : Pose2 or None
        Where the frame may be as well as anywhere, given no guess: near it matches are looked for
        first, which is much less work, and everywhere unless those convince.
    """
    near = PyramidPair(keyframe.levels, prepared.levels)
    searched_metres = 0.0 if window is None or guess is not None else window.radius_metres
    if expected is not None and guess is None and not len(prepared.repeats):
        case = _match(keyframe, prepared, expected, calibration, options, searched_metres)
        if (trial := _believed(case, near)) is not None:
            return trial
    case = _match(keyframe, prepared, guess, calibration, options, searched_metres)
    alignment = case.alignment
    ask_pixels = options.dense and not (window is None and guess is None)
    if not ask_pixels and options.dense and not acceptance.enough_inliers(alignment, options):
        return case.trial(None, alignment.reason or acceptance.too_few_inliers(alignment, options))
    by_features = _refined(case, near)
    if by_features is not None:
        rejection = _doubt(case, near, by_features)
        if rejection is not None and not (rejection and ask_pixels):
            return case.trial(by_features, rejection)
        if by_features.pose.translation_length > case.max_displacement_metres:
            by_features = None
    if not ask_pixels:
        return case.trial(
            by_features, alignment.reason or acceptance.too_few_inliers(alignment, options)
        )
    if guess is not None:
        fits = []
        if by_features is None or not refinement.converges_to(near, guess, by_features):
            fit = refinement.refine_hypothesis(near, guess, None, calibration, options)
            fits = [] if fit is None else [fit]
        return case.choose(near, fits, by_features, None)
    assert window is not None
    return _searched(
        case,
        near,
        by_features,
        replace(window, max_displacement_metres=case.max_displacement_metres),
    )


def _searched(
    case: PairContext,
    near: PyramidPair,
    by_features: MotionHypothesis | None,
    window: dense.SearchWindow,
) -> RegistrationResult:
    """Return the trial of what the pixels show within a window, near the robot or farther off."""
    keyframe, prepared = case.keyframe, case.prepared
    found, fits = hypotheses.search(near, window, case.calibration, case.options)
    trial = case.choose(near, fits, by_features, found)
    if trial.link is not None or not (keyframe.far_levels and prepared.far_levels):
        return trial
    far = PyramidPair(keyframe.far_levels, prepared.far_levels, far=True)
    _, fits = hypotheses.search(far, window, case.calibration, case.options)
    near_fits = [
        refinement.refine_on_near_view(near, fit, case.calibration, case.options) for fit in fits
    ]
    second = case.choose(far, near_fits, None, found)
    return trial if second.link is None else second


def _match(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    guess: Pose2 | None,
    calibration: Calibration,
    options: MapperOptions,
    searched_metres: float,
) -> PairContext:
    """Return what the features say, matched near a guess if there is one."""
    assert keyframe.features is not None
    assert prepared.features is not None
    matching = replace(
        options.matching,
        model="rigid",
        search_radius=_SEARCH_SHARE_OF_RANGE * calibration.max_range_metres,
    )
    alignment = align.align(keyframe.features, prepared.features, matching, guess)
    return PairContext(keyframe, prepared, alignment, calibration, options, searched_metres)


def _refined(case: PairContext, near: PyramidPair) -> MotionHypothesis | None:
    """Return the features' motion refined on the pixels; None when they tell none."""
    alignment = case.alignment
    if alignment.pose is None or alignment.covariance is None or alignment.reason:
        return None
    return refinement.refine_hypothesis(
        near, alignment.pose, alignment.covariance, case.calibration, case.options
    )


def _believed(case: PairContext, near: PyramidPair) -> RegistrationResult | None:
    """Return the trial of a motion that many features tell and nothing speaks against, or None."""
    fit = _refined(case, near) if acceptance.enough_inliers(case.alignment, case.options) else None
    return case.trial(fit, "") if fit is not None and _doubt(case, near, fit) == "" else None


def _doubt(case: PairContext, near: PyramidPair, fit: MotionHypothesis) -> str | None:
    """Return why the features' motion is not believed, or nothing; None: it does not convince."""
    options = case.options
    if options.dense and not acceptance.convincing(case.alignment, fit, options):
        return None
    return acceptance.check_plausible(
        fit, case.max_displacement_metres, options, beside_features=options.dense
    ) or case.check_period(near, fit)
