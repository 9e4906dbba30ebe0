"""Robust statistics and the closed-form rigid fit in the plane, as several stages need them."""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2

# Of normal errors: their standard deviation over the median of their absolute values (MAD).
SIGMA_PER_MAD = 1.4826
# The inverse: the median of the absolute value of a normal error in one direction, in sigmas.
NORMAL_MEDIAN = 0.6745
# Its length in two directions: the median of a Rayleigh distribution.
RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))
# Geman and McClure's scale in sigmas: keeps 91 % of the efficiency of least squares on normal
# errors (89 % in two directions), and all but ignores an outlier of five sigmas
# [tests/core/test_robust.py].
GEMAN_MCCLURE_SIGMAS = 3.0


def geman_mcclure_weights(squared_ratios: Float64Array) -> Float64Array:
    """Return the weights of Geman and McClure's kernel, 1 for a residual of 0 and falling to 0.

    Parameters
    ----------
    squared_ratios : array
        (residual / scale)^2 (Geman and McClure, Bulletin of the ISI 52, 1987; the scale is
        usually `GEMAN_MCCLURE_SIGMAS` standard deviations).
    """
    weights: Float64Array = (1.0 + squared_ratios) ** -2
    return weights


def fit_rigid_2d(a: Float64Array, b: Float64Array, weights: Float64Array | None = None) -> Pose2:
    """Return ``a_from_b``, the least-squares rigid motion between (N, 2) point pairs.

    In closed form (Umeyama, PAMI 13, 1991, eqs. 40-41; in the plane the rotation is the angle of
    one complex sum, and no reflection can come out). `stages.align.models` fits many at once.

    Parameters
    ----------
    a, b : (N, 2) float64
        In one unit.
    weights : (N,) float64 or None
        None: all alike.
    """
    if weights is None:
        centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
        from_a, from_b = a - centre_a, b - centre_b
    else:
        share = weights[:, None]
        total = share.sum(axis=0)
        centre_a, centre_b = (share * a).sum(axis=0) / total, (share * b).sum(axis=0) / total
        from_a, from_b = share * (a - centre_a), b - centre_b
    sine = float(np.sum(from_b[:, 0] * from_a[:, 1] - from_b[:, 1] * from_a[:, 0]))
    turn = math.atan2(sine, float(np.sum(from_b * from_a)))
    moved = Pose2(0.0, 0.0, turn).apply(centre_b)
    return Pose2(float(centre_a[0] - moved[0]), float(centre_a[1] - moved[1]), turn)
