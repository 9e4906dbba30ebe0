"""One frame against one keyframe: what fits, and whether the pixels let it be believed.

Features come first. When they are few, badly spread, or the pixels do not confirm their fit, every
motion within reach is searched on the pixels themselves, and one is believed when it explains them
clearly better than any other. What lies beyond the range of the features, smeared as it is, is
asked last: it holds the motion where the near floor is bare, plain or hardly shared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from slamcli.comparison import belief, hypotheses, score
from slamcli.comparison.hypotheses import Hypothesis, Pair
from slamcli.core.records import Link
from slamcli.stages import align

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from slamcli.core.config import MapperOptions
    from slamcli.core.geometry import Pose2
    from slamcli.core.records import Alignment, Calibration, Prepared
    from slamcli.stages import dense

# How far from a guess matches are looked for, as a share of how far the camera sees.
_SEARCH_SHARE_OF_RANGE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One comparison of a frame with a keyframe: what fits, or why nothing does.

    Attributes
    ----------
    keyframe, prepared : Prepared
    alignment : Alignment
        What the features said.
    link : Link or None
    fit : Hypothesis or None
        The motion that explains the frames best, believed or not.
    evidence : (K,) float64 or None
        What speaks for that and against it, in the order of `score.EVIDENCE`; None without one.
    reason : str
        Why there is no link; empty when there is one.
    rival : float
        Evidence of the next best motion over that of the best, in [0, 1]; nan when the features
        alone decided.
    search : Search or None
        What the pixels were asked, when they were.
    partial : Link or None
        Where nothing but a direction that the pixels leave open speaks against the fit: what they
        do tell, of kind ``partial``. It is worth something beside odometry.
    """

    keyframe: Prepared
    prepared: Prepared
    alignment: Alignment
    link: Link | None
    fit: Hypothesis | None
    evidence: NDArray[np.float64] | None
    reason: str = ""
    rival: float = math.nan
    search: dense.Search | None = None
    partial: Link | None = None

    @property
    def score(self) -> float:
        """How likely the fit is right, in [0, 1]; 0 without one."""
        return 0.0 if self.evidence is None else score.score(self.evidence)

    @property
    def overlap(self) -> float:
        """Share of the smaller view's floor that both see; 0 when nothing gave a fit."""
        return 0.0 if self.fit is None else self.fit.agreed.overlap

    @property
    def correlation(self) -> float:
        """Of the overlap's pixels, in [-1, 1]; nan when nothing gave a fit."""
        return math.nan if self.fit is None else self.fit.agreed.correlation

    @property
    def confirmed(self) -> float:
        """Share of the floor's patches that agree with the fit; nan where too few tell."""
        return math.nan if self.fit is None else self.fit.agreed.confirmed


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
    case = _Case(keyframe, prepared, alignment, calibration, options, searched_metres)
    ask_pixels = options.dense and not (window is None and guess is None)
    if not ask_pixels and options.dense and not belief.many(alignment, options):
        return case.trial(None, alignment.reason or belief.few(alignment, options))
    by_features = None
    if alignment.pose is not None and alignment.covariance is not None and not alignment.reason:
        by_features = hypotheses.polish(
            near, alignment.pose, alignment.covariance, calibration, options
        )
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
        if by_features is None or not hypotheses.leads_to(near, guess, by_features):
            fit = hypotheses.polish(near, guess, None, calibration, options)
            fits = [fit] if fit.covariance is not None else []
        return case.choose(near, fits, by_features, None)
    assert window is not None
    window = replace(window, way_metres=case.way_metres)
    found, fits = hypotheses.search(near, window, calibration, options)
    trial = case.choose(near, fits, by_features, found)
    if trial.link is not None or not (keyframe.far_levels and prepared.far_levels):
        return trial
    far = Pair(keyframe.far_levels, prepared.far_levels, far=True)
    _, fits = hypotheses.search(far, window, calibration, options)
    sharper = [hypotheses.sharpen(near, fit, calibration, options) for fit in fits]
    second = case.choose(far, sharper, None, found)
    return trial if second.link is None else second


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """Two frames, what their features say, and what the believing is bound to."""

    keyframe: Prepared
    prepared: Prepared
    alignment: Alignment
    calibration: Calibration
    options: MapperOptions
    searched_metres: float

    @property
    def way_metres(self) -> float:
        """The farthest that the robot may have gone from one frame to the other."""
        return belief.way_metres(self.keyframe.index, self.prepared.index, self.options)

    def choose(
        self,
        pair: Pair,
        fits: list[Hypothesis],
        by_features: Hypothesis | None,
        found: dense.Search | None,
    ) -> Trial:
        """Believe the motion that explains the pixels best, if it does so well and alone."""
        backed_by_features = by_features is not None and belief.backing(
            self.alignment, self.options
        )
        if by_features is not None:
            if backed_by_features:
                fits = self._of_the_floor(fits, pair, by_features)
            fits = [*fits, by_features]
        fits = hypotheses.distinct(fits, pair)
        if not fits:
            return self.trial(
                None, self.alignment.reason or "the pixels show no motion", 1.0, found
            )
        best = fits[0]
        differs = by_features is not None and not hypotheses.same(by_features.pose, best.pose, pair)
        backed = backed_by_features and not differs
        range_metres = self.calibration.max_range_metres
        undetermined = "" if backed else belief.undetermined(best, range_metres, self.options)
        is_open = bool(undetermined)
        others = hypotheses.elsewhere(fits[1:], best) if is_open else fits[1:]
        rival = self._rival(pair, best, others)
        doubt = belief.implausible(best, self.way_metres, self.options, backed=backed)
        if not doubt and not backed:
            doubt = belief.unlike(pair, best, self.options)
        if not doubt and differs and belief.many(self.alignment, self.options):
            doubt = "the pixels speak for another motion than the features do"
        if not doubt:
            doubt = belief.ambiguous(rival, self.options)
        if not doubt:
            doubt = self.repeats(pair, best, is_open=is_open)
        partly = is_open and not doubt
        return self.trial(best, doubt or undetermined, rival, found, partly=partly)

    def _of_the_floor(
        self, fits: list[Hypothesis], pair: Pair, by_features: Hypothesis
    ) -> list[Hypothesis]:
        """Leave out what legs make of a motion that features speak for, and their own motions."""
        kept = []
        for fit in fits:
            if hypotheses.same(fit.pose, by_features.pose, pair):
                if not (hypotheses.crowded(by_features) and hypotheses.crowded(fit)):
                    kept.append(fit)
            elif not belief.implausible(fit, self.way_metres, self.options):
                kept.append(fit)
        return kept

    def _rival(self, pair: Pair, best: Hypothesis, others: list[Hypothesis]) -> float:
        """Return the evidence of the strongest motion that the best does not stand out from."""
        for other in others:
            share = other.evidence / best.evidence if best.evidence > 0 else 1.0
            if share <= self.options.max_rival_evidence:
                return share
            if not hypotheses.stands_out(pair, best, other):
                return share
        return 0.0

    def repeats(self, near: Pair, fit: Hypothesis, *, is_open: bool = False) -> str:
        """Return why a floor that repeats leaves a fit open, or nothing.

        Parameters
        ----------
        near : Pair
        fit : Hypothesis
        is_open : bool
            Whether the fit is open in some direction anyhow, as along a line.
        """
        if near.far or not len(self.prepared.repeats):
            return ""
        rivals = hypotheses.repeated(
            near, fit, self.prepared.repeats, self.calibration, self.options
        )
        if is_open:
            rivals = hypotheses.elsewhere(rivals, fit)
        like = [
            rival
            for rival in rivals
            if rival.pose.translation_length <= self.way_metres
            and not hypotheses.stands_out(near, fit, rival)
        ]
        return belief.repeating(fit, like, self.options) if like else ""

    def trial(
        self,
        fit: Hypothesis | None,
        doubt: str,
        rival: float = math.nan,
        found: dense.Search | None = None,
        *,
        partly: bool = False,
    ) -> Trial:
        """Return the trial of a fit: with its link, or with why there is none.

        Parameters
        ----------
        fit : Hypothesis or None
        doubt : str
        rival : float
        found : Search or None
        partly : bool
            Whether the doubt is of some direction alone.
        """
        link = partial = evidence = None
        if fit is not None:
            pair = Pair(self.keyframe.levels, self.prepared.levels)
            range_metres = self.calibration.max_range_metres
            evidence = score.evidence(
                fit, self.alignment, rival, self.searched_metres, range_metres, pair
            )
        if fit is not None and fit.covariance is not None and (partly or not doubt):
            assert evidence is not None
            told = Link(
                self.keyframe.index,
                self.prepared.index,
                fit.pose,
                fit.covariance,
                self.alignment.inlier_count if math.isnan(rival) else 0,
                score.score(evidence),
                "partial" if partly else "step",
            )
            link, partial = (None, told) if partly else (told, None)
        reason = "" if link is not None else f"{doubt} (to {self.keyframe.name})"
        return Trial(
            self.keyframe,
            self.prepared,
            self.alignment,
            link,
            fit,
            evidence,
            reason,
            rival,
            found,
            partial,
        )
