"""The confidence in a measured motion: one probability from all evidence for it and against it.

A logistic model of the evidence, its weights fitted by `benchmarks/score.py` to the comparisons of
simulated drives over all floors, with and without disturbances, where the truth is known: of all
motions that it gives 0.9, about nine in ten are within 5 cm and 2 degrees of it.
"""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.records import FeatureAlignment
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair, same_motion

# Names of the evidence, each about 0 to 1, and its weight in the log-odds that a motion is right
# [fitted by benchmarks/score.py to 1,582 motions; the table of benchmarks/README.md checks it].
EVIDENCE = (
    "constant",
    "correlation of the overlap",
    "agreeing patches",
    "too few informative patches",
    "overlap",
    "inliers that agree",
    "inliers that disagree",
    "rival",
    "sharpness",
    "searched far and wide",
)
WEIGHTS = np.array([-2.05, 2.07, 2.00, 1.00, 1.48, 5.10, -2.07, -1.49, 2.10, -2.61])
# Scales of the evidence, which the weights were fitted with: this many inliers, a motion known to
# this share of the camera's range, and a correlation that leaves this share unexplained each count
# as 1 [benchmarks/score.py].
_MANY_INLIERS = 1000.0
_SHARP_SHARE = 1e-4
_MIN_UNEXPLAINED = 1e-3


def evidence(
    fit: MotionHypothesis,
    alignment: FeatureAlignment,
    rival: float,
    searched_metres: float,
    range_metres: float,
    pair: PyramidPair,
) -> Float64Array:
    """Return (K,) evidence about a motion, in the order of `EVIDENCE`, each about 0 to 1.

    Parameters
    ----------
    fit : MotionHypothesis
    alignment : FeatureAlignment
        Of the features alone.
    rival : float
        Evidence of the next best motion as a share of this one's; nan when none was looked for.
    searched_metres : float
        Radius around the expected motion in which the pixels were searched.
    range_metres : float
        How far the camera sees.
    pair : PyramidPair
    """
    agreement = fit.agreement
    inliers = math.log1p(alignment.inlier_count) / math.log1p(_MANY_INLIERS)
    agrees = alignment.pose is not None and same_motion(alignment.pose, fit.pose, pair)
    share = max(math.sqrt(fit.max_variance) / range_metres, 1e-12)
    sharpness = min(max(math.log(share) / math.log(_SHARP_SHARE), 0.0), 1.0)
    return np.array(
        [
            1.0,
            _similarity(agreement.correlation),
            0.0 if math.isnan(agreement.confirmed) else agreement.confirmed,
            float(math.isnan(agreement.confirmed)),
            min(agreement.overlap, 1.0),
            inliers if agrees else 0.0,
            0.0 if agrees else inliers,
            0.0 if math.isnan(rival) else rival,
            sharpness,
            0.0 if math.isnan(rival) else min(searched_metres / range_metres, 1.0),
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
    return 1.0 / (1.0 + math.exp(-float(WEIGHTS @ evidence_of_motion)))
