"""Voting: the rigid motion that most matches between a frame and a keyframe agree with.

On a floor seen from above, a true motion keeps every distance between points (rigid, of constant
scale); matches by chance do not.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from slamcli.core.arrays import Float32Array, IntpArray
from slamcli.core.geometry import Pose2
from slamcli.core.robust import fit_rigid_2d

# Matches that must agree. [benchmarks/locate.py: 0 of 250 frames of other floor placed]
MIN_VOTES = 5
_MAX_HYPOTHESES = 200
# Largest residual of a match that agrees, in sigmas of its two points.
_AGREEING_SIGMAS = 4.0
# Two points must be this many tolerances apart, or their errors decide the turn.
_MIN_BASE = 10.0
# The second refit adds what the first one's better motion agrees with.
_REFITS = 2


def vote(points_a: Float32Array, points_b: Float32Array) -> tuple[Pose2, int] | None:
    """Return the rigid motion ``a_from_b`` that most matched points agree with, and their number.

    Every pair of matches that keeps its distance gives a hypothesis; the longest ones are tried.
    None when fewer than `MIN_VOTES` agree.

    Parameters
    ----------
    points_a, points_b : (M, 3) float32
        x, y and sigma, metres.
    """
    if len(points_a) < MIN_VOTES:
        return None
    a, b = points_a[:, :2].astype(np.float64), points_b[:, :2].astype(np.float64)
    tolerance = _AGREEING_SIGMAS * np.hypot(points_a[:, 2], points_b[:, 2]).astype(np.float64)
    # Points as complex numbers: a motion turns and shifts them in one product.
    at_a, at_b = a[:, 0] + 1j * a[:, 1], b[:, 0] + 1j * b[:, 1]
    first, second = _pairs(len(a))
    base_a, base_b = at_a[second] - at_a[first], at_b[second] - at_b[first]
    length_a = np.abs(base_a)
    slack = np.sqrt((tolerance**2)[first] + (tolerance**2)[second])
    sound = np.abs(length_a - np.abs(base_b)) < slack
    sound &= length_a > _MIN_BASE * slack
    pairs = np.flatnonzero(sound)
    if not len(pairs):
        return None
    # In the longest pairs, for their tolerance, the points' errors turn a motion least.
    pairs = pairs[np.argsort(-(length_a / slack)[pairs], kind="stable")[:_MAX_HYPOTHESES]]
    turns = base_a[pairs] * base_b[pairs].conj()
    turns /= np.abs(turns)
    middle_a = 0.5 * (at_a[first[pairs]] + at_a[second[pairs]])
    middle_b = 0.5 * (at_b[first[pairs]] + at_b[second[pairs]])
    away = turns[:, None] * at_b + (middle_a - turns * middle_b)[:, None] - at_a
    inliers = away.real**2 + away.imag**2 < tolerance**2
    best = int(inliers.sum(axis=1).argmax())
    pose, agree = Pose2(), inliers[best]
    for _ in range(_REFITS):
        if np.count_nonzero(agree) < MIN_VOTES:
            return None
        pose = fit_rigid_2d(a[agree], b[agree], 1.0 / tolerance[agree] ** 2)
        agree = np.sum((pose.apply(b) - a) ** 2, axis=1) < tolerance**2
    count = int(np.count_nonzero(agree))
    return (pose, count) if count >= MIN_VOTES else None


@lru_cache(maxsize=256)
def _pairs(count: int) -> tuple[IntpArray, IntpArray]:
    """Return the numbers of every two of some matches, of which there are at most a few dozen."""
    first, second = np.triu_indices(count, 1)
    return first, second
