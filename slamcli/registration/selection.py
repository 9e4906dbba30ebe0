"""Selection of the motion between two frames among the hypotheses of features and pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2, wrap_angle
from slamcli.core.records import FeatureAlignment, Link, PreparedFrame
from slamcli.registration import acceptance, confidence, criteria, hypotheses, open_motion, rivals
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair, same_motion
from slamcli.registration.marks import RepeatMarks
from slamcli.registration.result import RegistrationResult, Verdict
from slamcli.stages import dense

# Share of the smaller view below which an expected motion cannot be compared by the pixels
# [guarded by benchmarks/tiles.py: 0.45 and 0.60 m, links to earlier keyframes].
_MIN_EXPECTED_OVERLAP = 0.2
# Share of the camera's range up to which the sigma of what is expected supports a motion; the free
# motion of a step, before a robot's steadiness is known, does not
# [guarded by benchmarks/courses.py].
_MAX_SUPPORTING_SHARE = 0.1
# Share of the informative patches that a motion must explain for an expected one to exclude others
# without a look at the pixels [benchmarks/score.py, tiles and a prior one tile off: false motions
# 0.75 to 0.92].
_MIN_CONFIRMED_AS_EXPECTED = 0.95
# [guarded by benchmarks/robustness.py: rocking on asphalt].
_SIGMA_FACTOR_OF_FEATURES = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class PairContext:
    """A frame pair, its feature alignment and the options that decide acceptance.

    Attributes
    ----------
    keyframe, prepared : PreparedFrame
    alignment : FeatureAlignment
    calibration : Calibration
    options : MapperOptions
    searched_metres : float
        Radius in which the pixels are searched for a motion; 0 where they are not.
    prior : MotionPrior or None
        What is known of the motion from elsewhere: it chooses among motions that the pixels support
        alike, and is no evidence for any.
    """

    keyframe: PreparedFrame
    prepared: PreparedFrame
    alignment: FeatureAlignment
    calibration: Calibration
    options: MapperOptions
    searched_metres: float
    prior: dense.MotionPrior | None = None

    @property
    def max_displacement_metres(self) -> float:
        """The farthest that the robot may have moved from one frame to the other."""
        return acceptance.max_displacement_metres(
            self.keyframe.index, self.prepared.index, self.options
        )

    def choose(
        self,
        pair: PyramidPair,
        fits: Sequence[MotionHypothesis],
        by_features: MotionHypothesis | None,
        search: dense.Search | None,
    ) -> RegistrationResult:
        """Return the result for the motion that explains the pixels best, if well and uniquely."""
        backed_by_features = by_features is not None and acceptance.backed_by_features(
            self.alignment, self.options
        )
        candidates = self._candidates(pair, fits, by_features, backed=backed_by_features)
        if not candidates:
            reason = self.alignment.reason or "the pixels determine no motion"
            return self.result(None, Verdict.of(reason), 1.0, search)
        best = candidates[0] if backed_by_features else self._explaining_most(candidates)
        candidates.remove(best)
        contradicts = by_features is not None and not same_motion(by_features.pose, best.pose, pair)
        backed = backed_by_features and not contradicts
        unobservable = "" if backed else self._check_observable(best)
        is_open, others = bool(unobservable), candidates
        if rivals.is_expected(self.prior, best.pose):
            others = [one for one in others if not rivals.is_excluded(self.prior, one.pose)]
        if is_open:
            others = hypotheses.outside_open_direction(others, best)
        rival = self._rival(pair, best, others)
        rejection = (
            acceptance.check_plausible(
                best, self.max_displacement_metres, self.options, backed=backed
            )
            or ("" if backed else acceptance.check_similarity(pair, best, self.options))
            or acceptance.check_agrees_with_features(
                self.alignment, self.options, contradicts=contradicts
            )
            or acceptance.check_unique(rival, self.options)
            or self.check_rivals(pair, best, is_open=is_open)
        )
        verdict = Verdict.of(rejection)
        if is_open and not rejection:
            verdict = Verdict("partial", unobservable)
            best = self._open_motion(pair, best)
        return self.result(best, verdict, rival, search)

    def _candidates(
        self,
        pair: PyramidPair,
        fits: Sequence[MotionHypothesis],
        by_features: MotionHypothesis | None,
        *,
        backed: bool,
    ) -> list[MotionHypothesis]:
        """Return the motions to choose among, best first, each once."""
        candidates = list(fits)
        if by_features is not None:
            if backed:
                candidates = self._without_obstacle_motions(candidates, pair, by_features)
            candidates.append(by_features)
        return hypotheses.without_duplicates(candidates, pair)

    def _explaining_most(self, candidates: Sequence[MotionHypothesis]) -> MotionHypothesis:
        """Return the first candidate, or one after it that explains much that it does not.

        Evidence counts pixels: where a pattern repeats, a wide overlap that fits the pattern alone
        has more of it than the right motion with less in common.
        """
        best = candidates[0]
        for other in candidates[1:]:
            nearly_all = best.agreement.confirmed >= criteria.SETTINGS.min_explained_share
            if not nearly_all and criteria.explains_more(other.agreement, best.agreement):
                best = other
        return best

    def _without_obstacle_motions(
        self, fits: Sequence[MotionHypothesis], pair: PyramidPair, by_features: MotionHypothesis
    ) -> list[MotionHypothesis]:
        """Leave out the motions of obstacles, and what obstacles make of the features' motion."""
        kept = []
        for fit in fits:
            if same_motion(fit.pose, by_features.pose, pair):
                if not (
                    criteria.mostly_obstructed(by_features) and criteria.mostly_obstructed(fit)
                ):
                    kept.append(fit)
            elif not acceptance.check_plausible(fit, self.max_displacement_metres, self.options):
                kept.append(fit)
        return kept

    def _check_observable(self, fit: MotionHypothesis) -> str:
        # Over a floor of many features a camera that rocks leaves a motion less certain, not wrong.
        share, backed = self.options.max_sigma_share, False
        if acceptance.backed_by_features(self.alignment, self.options):
            share, backed = share * _SIGMA_FACTOR_OF_FEATURES, True
        options = replace(self.options, max_sigma_share=share)
        return acceptance.check_observable(
            fit, self.calibration.max_range_metres, options, backed=backed
        )

    def _open_motion(self, pair: PyramidPair, fit: MotionHypothesis) -> MotionHypothesis:
        """Return an open motion where it is expected, with the covariance that shows it open."""
        if not self._check_observable(replace(fit, covariance=fit.predicted_covariance)):
            # The residuals alone show it; in the other directions gradients are on the safe side.
            fit = replace(fit, predicted_covariance=fit.predicted_covariance + fit.covariance)
        if self.prior is None:
            return fit
        return open_motion.where_expected(pair, fit, self.prior, self.calibration, self.options)

    def _rival(
        self, pair: PyramidPair, best: MotionHypothesis, others: Sequence[MotionHypothesis]
    ) -> float:
        """Return the share of evidence of the strongest motion that patches do not rule out."""
        for other in others:
            share = other.evidence / best.evidence if best.evidence > 0 else 1.0
            if share <= self.options.max_rival_evidence:
                return share
            ruled_out = criteria.explains_more(best.agreement, other.agreement)
            if not ruled_out and not hypotheses.preferred(pair, best, other):
                return share
        return 0.0

    def check_rivals(
        self, near: PyramidPair, fit: MotionHypothesis, *, is_open: bool = False
    ) -> str:
        """Return which other motion fits as well as a fit, or "".

        Parameters
        ----------
        near : PyramidPair
        fit : MotionHypothesis
        is_open : bool
            Whether the fit is open in some direction anyhow, as along a line.
        """
        if near.far:
            return ""
        if self._expected_beyond_view(near, fit):
            assert self.prior is not None
            return acceptance.expected_elsewhere(fit, self.prior.a_from_b)
        alternatives = rivals.refined(near, fit, self.suggested(fit), self.calibration)
        if is_open:
            alternatives = iter(hypotheses.outside_open_direction(list(alternatives), fit))
        periods = self.keyframe.repeats, self.prepared.repeats
        marks = RepeatMarks(near, *periods, self.calibration)
        remaining = (one for one in alternatives if self._remains(near, fit, one, marks))
        return acceptance.check_rivals(fit, next(remaining, None))

    def _expected_beyond_view(self, near: PyramidPair, fit: MotionHypothesis) -> bool:
        """Return whether a fit contradicts an expected motion that the pixels cannot tell of.

        Under that motion the views show next to nothing in common; a pattern may imitate overlap.
        """
        if self.prior is None or not rivals.is_excluded(self.prior, fit.pose):
            return False
        expected = dense.agreement(near.a[-1], near.b[-1], self.prior.a_from_b.matrix)
        return expected.overlap < _MIN_EXPECTED_OVERLAP

    def _remains(
        self,
        near: PyramidPair,
        fit: MotionHypothesis,
        rival: MotionHypothesis,
        marks: RepeatMarks,
    ) -> bool:
        """Return whether neither the robot's reach nor the pixels rule a rival out."""
        if not self._is_possible(rival.pose) or acceptance.check_plausible(
            rival, self.max_displacement_metres, self.options
        ):
            return False
        if criteria.explains_more(fit.agreement, rival.agreement):
            return False
        if self._excludes(rival.pose, fit.pose):
            return hypotheses.preferred(near, rival, fit)
        surprising = rivals.is_excluded(self.prior, fit.pose)
        expected_instead = surprising and rivals.is_expected(self.prior, rival.pose)
        # A narrow strip fits nearly anything, and shows few marks: its total evidence counts, or
        # marks in it that the fit does not explain, or no marks that support the fit itself; unless
        # the robot was expected there.
        share = hypotheses.SETTINGS.min_compared_share
        if rival.agreement.overlap < share * fit.agreement.overlap and not expected_instead:
            limit = self.options.max_rival_evidence * fit.evidence
            return (
                rival.evidence > limit
                or hypotheses.preferred_by_marks(near, rival, fit)
                or not marks.support(fit)
            )
        return not (hypotheses.preferred(near, fit, rival) or marks.rule_out(rival, fit))

    def suggested(self, fit: MotionHypothesis) -> list[Pose2]:
        """Return the motions that the floor and the prior suggest beside a fit."""
        suggested = rivals.starts(fit.pose, self.keyframe.repeats, self.prepared.repeats)
        # A prior may be wrong; where the fit explains all, no other motion explains more.
        explained = not fit.agreement.confirmed < _MIN_CONFIRMED_AS_EXPECTED
        starts = [
            start
            for start in suggested
            if self._is_possible(start) and not (explained and self._excludes(start, fit.pose))
        ]
        if self.prior is not None and rivals.is_excluded(self.prior, fit.pose):
            starts.insert(0, self.prior.a_from_b)
        return starts

    def _excludes(self, pose: Pose2, fit: Pose2) -> bool:
        """Return whether the prior excludes a motion beside a fit that is as expected."""
        return rivals.is_expected(self.prior, fit) and rivals.is_excluded(self.prior, pose)

    def _is_possible(self, pose: Pose2) -> bool:
        """Return whether the robot may have moved so."""
        return (
            pose.translation_length <= self.max_displacement_metres
            and abs(math.degrees(wrap_angle(pose.theta))) <= self.options.max_turn_degrees
        )

    def result(
        self,
        fit: MotionHypothesis | None,
        verdict: Verdict,
        rival: float = math.nan,
        search: dense.Search | None = None,
    ) -> RegistrationResult:
        """Return the result of a fit: with its link, or with why there is none.

        Parameters
        ----------
        fit : MotionHypothesis or None
        verdict : Verdict
        rival : float
            Evidence of the next best motion over the fit's; nan where the features alone decided.
        search : Search or None
        """
        link = partial = evidence = None
        if fit is not None:
            evidence = self._evidence(fit, verdict, rival)
            inliers = self.alignment.inlier_count if math.isnan(rival) else 0
            score = confidence.score(evidence)
            if verdict.outcome in ("accepted", "partial"):
                rejection = self._check_support(fit, rival, score)
                verdict = Verdict.of(rejection) if rejection else verdict
            frames = self.keyframe.index, self.prepared.index
            if verdict.outcome == "accepted":
                link = Link(*frames, fit.pose, fit.covariance, inliers, score, "step")
            elif verdict.outcome == "partial":
                covariance = fit.predicted_covariance
                partial = Link(*frames, fit.pose, covariance, inliers, score, "partial")
        reason = "" if link is not None else f"{verdict.reason} (to {self.keyframe.name})"
        return RegistrationResult(
            self.keyframe,
            self.prepared,
            self.alignment,
            link,
            fit,
            evidence,
            reason,
            rival,
            search,
            partial,
        )

    def _check_support(self, fit: MotionHypothesis, rival: float, score: float) -> str:
        """Return why a motion is not accepted that is likely to be wrong, or that only lines show.

        Patches, many features or what is expected support a motion. A wall or an obstacle that few
        lines of another view imitate contradicts what is expected.
        """
        supported = (
            math.isnan(rival)
            or not math.isnan(fit.agreement.confirmed)
            or acceptance.backed_by_features(self.alignment, self.options)
        )
        if not supported and rivals.is_surprising(self.prior, fit):
            assert self.prior is not None
            return acceptance.surprising(fit, self.prior.a_from_b)
        supported = supported or self._expects(fit)
        return acceptance.check_score(score, self.options, supported=supported)

    def _expects(self, fit: MotionHypothesis) -> bool:
        """Return whether a prior that is certain enough to support a motion expects it."""
        return (
            self.prior is not None
            and rivals.is_expected(self.prior, fit.pose)
            and math.sqrt(self.prior.covariance[:2, :2].max())
            <= _MAX_SUPPORTING_SHARE * self.calibration.max_range_metres
        )

    def _evidence(self, fit: MotionHypothesis, verdict: Verdict, rival: float) -> Float64Array:
        """Return the evidence about a motion, after the verdict on it."""
        ambiguous = verdict.is_ambiguous
        decision = confidence.Decision(
            rival,
            self.searched_metres,
            ambiguous or rival > self.options.max_rival_evidence,
            verdict.outcome in ("rejected", "inconclusive") and not ambiguous,
        )
        found = self.alignment.pose
        agrees = found is not None and same_motion(
            found, fit.pose, PyramidPair(self.keyframe.levels, self.prepared.levels)
        )
        range_metres = self.calibration.max_range_metres
        return confidence.evidence(fit, self.alignment, range_metres, decision, agrees=agrees)
