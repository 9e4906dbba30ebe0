"""The result of registering a frame against a keyframe, and the verdict on its motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from slamcli.core.arrays import Float64Array
from slamcli.core.records import FeatureAlignment, Link, PreparedFrame
from slamcli.registration import confidence
from slamcli.registration.hypothesis import MotionHypothesis
from slamcli.stages import dense

# How the reason begins wherever another motion fits as well.
AMBIGUOUS = "ambiguous"

Outcome = Literal["accepted", "partial", "rejected", "inconclusive"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the acceptance gates decide about a motion.

    Attributes
    ----------
    outcome : str
        ``accepted``: it becomes a link. ``partial``: nothing contradicts it, but the pixels leave
        one direction open. ``rejected``: a gate contradicts it. ``inconclusive``: no gate does, but
        the evidence is too weak to accept it.
    reason : str
        Why it is not accepted; may be empty where the outcome is ``inconclusive``.
    """

    outcome: Outcome
    reason: str = ""

    @property
    def is_ambiguous(self) -> bool:
        """Whether another motion remains that fits as well."""
        return self.reason.startswith(AMBIGUOUS)

    @classmethod
    def of(cls, rejection: str) -> Verdict:
        """Return the verdict of a gate: rejected with the reason that it gives, if any."""
        return cls("rejected", rejection) if rejection else ACCEPTED


ACCEPTED = Verdict("accepted")
INCONCLUSIVE = Verdict("inconclusive")


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationResult:
    """The registration of a frame against a keyframe: a link, or why there is none.

    Attributes
    ----------
    keyframe, prepared : PreparedFrame
    alignment : FeatureAlignment
        Of the features alone.
    link : Link or None
        The motion, if it was accepted.
    fit : MotionHypothesis or None
        The motion that explains the frames best, accepted or not.
    evidence : (K + 1,) float64 or None
        For that and against it: see `confidence.evidence`; None without one.
    reason : str
        Why there is no link; empty when there is one.
    rival : float
        Evidence of the next best motion over that of the best, in [0, 1]; nan when the features
        alone decided.
    search : Search or None
        What a search of the pixels found, when there was one.
    partial : Link or None
        Where nothing but an open direction prevents a link: the motion with its covariance, of kind
        ``partial``. Beside odometry it still constrains the other directions.
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

    def as_loop(self) -> RegistrationResult:
        """Return the same result, its link to floor that was seen before: of kind ``loop``."""
        assert self.link is not None
        return replace(self, link=replace(self.link, kind="loop"))

    @property
    def score(self) -> float:
        """Probability that the fit is right, in [0, 1]; 0 without one."""
        return 0.0 if self.evidence is None else confidence.score(self.evidence)

    @property
    def overlap(self) -> float:
        """Share of the smaller view's floor that both see; 0 without a fit."""
        return 0.0 if self.fit is None else self.fit.agreement.overlap

    @property
    def correlation(self) -> float:
        """Of the overlap's pixels, in [-1, 1]; nan without a fit."""
        return math.nan if self.fit is None else self.fit.agreement.correlation

    @property
    def confirmed(self) -> float:
        """Share of the informative patches that agree with the fit; nan where there are too few."""
        return math.nan if self.fit is None else self.fit.agreement.confirmed
