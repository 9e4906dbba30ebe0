"""A comparison's evidence, and what is believed of it: a link, or the reason why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.records import FeatureAlignment, Link, PreparedFrame
from slamcli.registration import acceptance, confidence, hypotheses, refinement
from slamcli.registration.refinement import MotionHypothesis, PyramidPair
from slamcli.stages import dense


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationResult:
    """One comparison of a frame with a keyframe: what fits, or why nothing does.

    Attributes
    ----------
    keyframe, prepared : PreparedFrame
    alignment : FeatureAlignment
        What the features said.
    link : Link or None
    fit : MotionHypothesis or None
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

    keyframe: PreparedFrame
    prepared: PreparedFrame
    alignment: FeatureAlignment
    link: Link | None
    fit: MotionHypothesis | None
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
class PairContext:
    """Two frames, what their features say, and what the believing is bound to."""

    keyframe: PreparedFrame
    prepared: PreparedFrame
    alignment: FeatureAlignment
    calibration: Calibration
    options: MapperOptions
    searched_metres: float

    @property
    def max_displacement_metres(self) -> float:
        """The farthest that the robot may have gone from one frame to the other."""
        return acceptance.max_displacement_metres(
            self.keyframe.index, self.prepared.index, self.options
        )

    def choose(
        self,
        pair: PyramidPair,
        fits: list[MotionHypothesis],
        by_features: MotionHypothesis | None,
        found: dense.Search | None,
    ) -> RegistrationResult:
        """Believe the motion that explains the pixels best, if it does so well and alone."""
        backed_by_features = by_features is not None and acceptance.backed_by_features(
            self.alignment, self.options
        )
        if by_features is not None:
            if backed_by_features:
                fits = self._of_the_floor(fits, pair, by_features)
            fits = [*fits, by_features]
        fits = hypotheses.without_duplicates(fits, pair)
        if not fits:
            return self.trial(
                None, self.alignment.reason or "the pixels show no motion", 1.0, found
            )
        best = fits[0]
        differs = by_features is not None and not refinement.same(by_features.pose, best.pose, pair)
        backed = backed_by_features and not differs
        range_metres = self.calibration.max_range_metres
        undetermined = (
            "" if backed else acceptance.check_observable(best, range_metres, self.options)
        )
        is_open = bool(undetermined)
        others = hypotheses.outside_open_direction(fits[1:], best) if is_open else fits[1:]
        rival = self._rival(pair, best, others)
        rejection = acceptance.check_plausible(
            best, self.max_displacement_metres, self.options, backed=backed
        )
        if not rejection and not backed:
            rejection = acceptance.check_similarity(pair, best, self.options)
        if not rejection and differs and acceptance.enough_inliers(self.alignment, self.options):
            rejection = "the pixels speak for another motion than the features do"
        if not rejection:
            rejection = acceptance.check_unique(rival, self.options)
        if not rejection:
            rejection = self.check_period(pair, best, is_open=is_open)
        partly = is_open and not rejection
        return self.trial(best, rejection or undetermined, rival, found, partly=partly)

    def _of_the_floor(
        self, fits: list[MotionHypothesis], pair: PyramidPair, by_features: MotionHypothesis
    ) -> list[MotionHypothesis]:
        """Leave out what legs make of a motion that features speak for, and their own motions."""
        kept = []
        for fit in fits:
            if refinement.same(fit.pose, by_features.pose, pair):
                if not (
                    refinement.mostly_obstructed(by_features) and refinement.mostly_obstructed(fit)
                ):
                    kept.append(fit)
            elif not acceptance.check_plausible(fit, self.max_displacement_metres, self.options):
                kept.append(fit)
        return kept

    def _rival(
        self, pair: PyramidPair, best: MotionHypothesis, others: list[MotionHypothesis]
    ) -> float:
        """Return the evidence of the strongest motion that the best does not stand out from."""
        for other in others:
            share = other.evidence / best.evidence if best.evidence > 0 else 1.0
            if share <= self.options.max_rival_evidence:
                return share
            if not hypotheses.preferred_by_patches(pair, best, other):
                return share
        return 0.0

    def check_period(
        self, near: PyramidPair, fit: MotionHypothesis, *, is_open: bool = False
    ) -> str:
        """Return why a floor that repeats leaves a fit open, or nothing.

        Parameters
        ----------
        near : PyramidPair
        fit : MotionHypothesis
        is_open : bool
            Whether the fit is open in some direction anyhow, as along a line.
        """
        if near.far or not len(self.prepared.repeats):
            return ""
        rivals = hypotheses.periodic_alternatives(
            near, fit, self.prepared.repeats, self.calibration, self.options
        )
        if is_open:
            rivals = hypotheses.outside_open_direction(rivals, fit)
        like = [
            rival
            for rival in rivals
            if rival.pose.translation_length <= self.max_displacement_metres
            and not hypotheses.preferred_by_patches(near, fit, rival)
        ]
        return acceptance.check_period(fit, like, self.options) if like else ""

    def trial(
        self,
        fit: MotionHypothesis | None,
        rejection: str,
        rival: float = math.nan,
        found: dense.Search | None = None,
        *,
        partly: bool = False,
    ) -> RegistrationResult:
        """Return the trial of a fit: with its link, or with why there is none.

        Parameters
        ----------
        fit : MotionHypothesis or None
        doubt : str
        rival : float
        found : Search or None
        partly : bool
            Whether the doubt is of some direction alone.
        """
        link = partial = evidence = None
        if fit is not None:
            pair = PyramidPair(self.keyframe.levels, self.prepared.levels)
            range_metres = self.calibration.max_range_metres
            evidence = confidence.evidence(
                fit, self.alignment, rival, self.searched_metres, range_metres, pair
            )
        if fit is not None and (partly or not rejection):
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
        reason = "" if link is not None else f"{rejection} (to {self.keyframe.name})"
        return RegistrationResult(
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
