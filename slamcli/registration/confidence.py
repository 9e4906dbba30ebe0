"""The confidence in a measured motion: one probability from all evidence for it and against it.

A logistic model of the evidence, monotone in every piece of it, its weights fitted by
`benchmarks/score.py` to motions over simulated floors of many kinds, where the truth is known.
Where another motion remains that fits as well, both share the probability. Of all motions that it
gives 0.9, about nine in ten are within 2 cm and 1 degree of the truth, over kinds of floors too
that it was not fitted to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.records import FeatureAlignment
from slamcli.registration.hypothesis import MotionHypothesis

# Names of the evidence, each about 0 to 1, and its weight in the log-odds that a motion is right
# [fitted by benchmarks/score.py; the table of benchmarks/README.md checks it].
EVIDENCE = (
    "constant",
    "correlation of the overlap",
    "agreeing patches",
    "too few informative patches",
    "inliers that agree",
    "share of the matches that agree",
    "inliers that disagree",
    "rival",
    "sharpness",
    "searched far and wide",
    "not accepted",
)
WEIGHTS = np.array([-6.12, 3.51, 5.82, 4.56, 2.55, 2.55, -2.88, -4.38, 3.92, -1.15, -0.42])
# Behind the evidence: how many other motions remain that fit as well, 0 or 1.
RIVALS_LEFT = len(EVIDENCE)
# Scales of the evidence, which the weights were fitted with: this many inliers, a motion known to
# this share of the camera's range, and a correlation that leaves this share unexplained each count
# as 1 [benchmarks/score.py].
_MANY_INLIERS = 1000.0
_SHARP_SHARE = 1e-4
_MIN_UNEXPLAINED = 1e-3


@dataclass(frozen=True, slots=True)
class Decision:
    """How a motion was chosen among others, and whether it was accepted.

    Attributes
    ----------
    rival : float
        Evidence of the next best motion as a share of this one's; nan when none was looked for.
    searched_metres : float
        Radius around the expected motion in which the pixels were searched.
    rival_left : bool
        Whether another motion remains that fits as well.
    refused : bool
        Whether the motion was not accepted, for another reason.
    """

    rival: float
    searched_metres: float
    rival_left: bool = False
    refused: bool = False


def evidence(
    fit: MotionHypothesis,
    alignment: FeatureAlignment,
    range_metres: float,
    decision: Decision,
    *,
    agrees: bool,
) -> Float64Array:
    """Return (K + 1,) evidence about a motion: in the order of `EVIDENCE`, then the rivals left.

    Parameters
    ----------
    fit : MotionHypothesis
    alignment : FeatureAlignment
        Of the features alone.
    range_metres : float
        How far the camera sees.
    decision : Decision
    agrees : bool
        Whether the features alone show the same motion.
    """
    agreement, rival = fit.agreement, decision.rival
    inliers = math.log1p(alignment.inlier_count) / math.log1p(_MANY_INLIERS)
    share = max(math.sqrt(fit.max_variance) / range_metres, 1e-12)
    sharpness = min(max(math.log(share) / math.log(_SHARP_SHARE), 0.0), 1.0)
    searched = min(decision.searched_metres / range_metres, 1.0)
    return np.array(
        [
            1.0,
            _similarity(agreement.correlation),
            0.0 if math.isnan(agreement.confirmed) else agreement.confirmed,
            float(math.isnan(agreement.confirmed)),
            inliers if agrees else 0.0,
            alignment.inlier_count / max(len(alignment.matches), 1) if agrees else 0.0,
            0.0 if agrees else inliers,
            0.0 if math.isnan(rival) else rival,
            sharpness,
            0.0 if math.isnan(rival) else searched,
            float(decision.refused),
            float(decision.rival_left),
        ]
    )


def _similarity(correlation: float) -> float:
    """Return how far a correlation is from chance: the logarithm of what it leaves unexplained."""
    if not correlation > 0.0:
        return 0.0
    unexplained = max(1.0 - correlation**2, _MIN_UNEXPLAINED)
    return math.log(unexplained) / math.log(_MIN_UNEXPLAINED)


def score(evidence_of_motion: Float64Array) -> float:
    """Return the probability, in [0, 1], that a motion with this evidence is right."""
    log_odds = float(WEIGHTS @ evidence_of_motion[:RIVALS_LEFT])
    return 1.0 / (1.0 + math.exp(-log_odds)) / (1.0 + float(evidence_of_motion[RIVALS_LEFT]))
