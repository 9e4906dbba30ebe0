"""How likely a motion is right: one number from all that speaks for it and against it.

A logistic model of the evidence, its weights fitted by `benchmarks/score.py` to the comparisons of
simulated drives over all floors, with and without disturbances, where the truth is known: of all
motions that it gives 0.9, about nine in ten are within 5 cm and 2 degrees of it.
"""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.records import FeatureAlignment
from slamcli.registration import refinement
from slamcli.registration.refinement import MotionHypothesis, PyramidPair

EVIDENCE = (
    "constant",
    "correlation of the overlap",
    "agreeing patches",
    "too few patches tell",
    "overlap",
    "inliers that agree",
    "inliers that disagree",
    "rival",
    "sharpness",
    "searched far and wide",
)
WEIGHTS = np.array([-2.05, 2.07, 2.00, 1.00, 1.48, 5.10, -2.07, -1.49, 2.10, -2.61])
# So many inliers, and a motion known to such a share of the camera's range, count as one.
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
    """Return (K,) what is told of a motion, in the order of `EVIDENCE`, each about 0 to 1.

    Parameters
    ----------
    fit : MotionHypothesis
    alignment : FeatureAlignment
        What the features said.
    rival : float
        Of the next best motion, its share of this one's evidence; nan when none was looked for.
    searched_metres : float
        How far about where the robot was heading the pixels were searched for one.
    range_metres : float
        How far the camera sees.
    pair : PyramidPair
    """
    agreed = fit.agreed
    inliers = math.log1p(alignment.inlier_count) / math.log1p(_MANY_INLIERS)
    alike = alignment.pose is not None and refinement.same(alignment.pose, fit.pose, pair)
    share = max(math.sqrt(refinement.widest_variance(fit)) / range_metres, 1e-12)
    sharpness = min(max(math.log(share) / math.log(_SHARP_SHARE), 0.0), 1.0)
    return np.array(
        [
            1.0,
            _similarity(agreed.correlation),
            0.0 if math.isnan(agreed.confirmed) else agreed.confirmed,
            float(math.isnan(agreed.confirmed)),
            min(agreed.overlap, 1.0),
            inliers if alike else 0.0,
            0.0 if alike else inliers,
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


def score(told: Float64Array) -> float:
    """Return the probability, in [0, 1], that a motion of which this evidence tells is right."""
    return 1.0 / (1.0 + math.exp(-float(WEIGHTS @ told)))
