"""A comparison's evidence, and what is believed of it: a link, or the reason why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.records import Alignment, Link, Prepared
from slamcli.registration import acceptance, confidence, hypotheses, refinement
from slamcli.registration.refinement import Hypothesis, Pair
from slamcli.stages import dense


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
    evidence: Float64Array | None
    reason: str = ""
    rival: float = math.nan
    search: dense.Search | None = None
    partial: Link | None = None

    @property
    def score(self) -> float:
        """How likely the fit is right, in [0, 1]; 0 without one."""
        return 0.0 if self.evidence is None else confidence.score(self.evidence)

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


@dataclass(frozen=True, slots=True, eq=False)
class Case:
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
        return acceptance.way_metres(self.keyframe.index, self.prepared.index, self.options)

    def choose(
        self,
        pair: Pair,
        fits: list[Hypothesis],
        by_features: Hypothesis | None,
        found: dense.Search | None,
    ) -> Trial:
        """Believe the motion that explains the pixels best, if it does so well and alone."""
        backed_by_features = by_features is not None and acceptance.backing(
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
        differs = by_features is not None and not refinement.same(by_features.pose, best.pose, pair)
        backed = backed_by_features and not differs
        range_metres = self.calibration.max_range_metres
        undetermined = "" if backed else acceptance.undetermined(best, range_metres, self.options)
        is_open = bool(undetermined)
        others = hypotheses.elsewhere(fits[1:], best) if is_open else fits[1:]
        rival = self._rival(pair, best, others)
        doubt = acceptance.implausible(best, self.way_metres, self.options, backed=backed)
        if not doubt and not backed:
            doubt = acceptance.unlike(pair, best, self.options)
        if not doubt and differs and acceptance.many(self.alignment, self.options):
            doubt = "the pixels speak for another motion than the features do"
        if not doubt:
            doubt = acceptance.ambiguous(rival, self.options)
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
            if refinement.same(fit.pose, by_features.pose, pair):
                if not (refinement.crowded(by_features) and refinement.crowded(fit)):
                    kept.append(fit)
            elif not acceptance.implausible(fit, self.way_metres, self.options):
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
        return acceptance.repeating(fit, like, self.options) if like else ""

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
            evidence = confidence.evidence(
                fit, self.alignment, rival, self.searched_metres, range_metres, pair
            )
        if fit is not None and (partly or not doubt):
            assert evidence is not None
            told = Link(
                self.keyframe.index,
                self.prepared.index,
                fit.pose,
                fit.covariance,
                self.alignment.inlier_count if math.isnan(rival) else 0,
                confidence.score(evidence),
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
