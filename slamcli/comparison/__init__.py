"""One frame against one keyframe: what fits, and whether the pixels let it be believed.

Features come first. When they are few, badly spread, or the pixels do not confirm their fit, every
motion within reach is searched on the pixels themselves, and one is believed when it explains them
clearly better than any other. What lies beyond the range of the features, smeared as it is, is
asked last: it holds the motion where the near floor is bare, plain or hardly shared.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from slamcli.comparison import belief, hypotheses, polishing
from slamcli.comparison.case import Case, Trial
from slamcli.comparison.polishing import Pair
from slamcli.stages import align

if TYPE_CHECKING:
    from slamcli.core.config import MapperOptions
    from slamcli.core.geometry import Pose2
    from slamcli.core.records import Calibration, Prepared
    from slamcli.stages import dense

__all__ = ["Trial", "compare"]

# How far from a guess matches are looked for, as a share of how far the camera sees.
_SEARCH_SHARE_OF_RANGE = 0.1


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
    near = Pair(keyframe.levels, prepared.levels)
    searched_metres = 0.0 if window is None or guess is not None else window.radius_metres
    case = Case(keyframe, prepared, alignment, calibration, options, searched_metres)
    ask_pixels = options.dense and not (window is None and guess is None)
    if not ask_pixels and options.dense and not belief.many(alignment, options):
        return case.trial(None, alignment.reason or belief.few(alignment, options))
    by_features = None
    if alignment.pose is not None and alignment.covariance is not None and not alignment.reason:
        by_features = polishing.polish(
            near, alignment.pose, alignment.covariance, calibration, options
        )
        assert by_features is not None
        if not options.dense or belief.convincing(alignment, by_features, options):
            doubt = belief.implausible(
                by_features, case.way_metres, options, beside_features=options.dense
            ) or case.repeats(near, by_features)
            if not doubt or not ask_pixels:
                return case.trial(by_features, doubt)
        if by_features.pose.translation_length > case.way_metres:
            by_features = None
    if not ask_pixels:
        return case.trial(by_features, alignment.reason or belief.few(alignment, options))
    if guess is not None:
        fits = []
        if by_features is None or not polishing.leads_to(near, guess, by_features):
            fit = polishing.polish(near, guess, None, calibration, options)
            fits = [] if fit is None else [fit]
        return case.choose(near, fits, by_features, None)
    assert window is not None
    window = replace(window, way_metres=case.way_metres)
    found, fits = hypotheses.search(near, window, calibration, options)
    trial = case.choose(near, fits, by_features, found)
    if trial.link is not None or not (keyframe.far_levels and prepared.far_levels):
        return trial
    far = Pair(keyframe.far_levels, prepared.far_levels, far=True)
    _, fits = hypotheses.search(far, window, calibration, options)
    sharper = [polishing.sharpen(near, fit, calibration, options) for fit in fits]
    second = case.choose(far, sharper, None, found)
    return trial if second.link is None else second
