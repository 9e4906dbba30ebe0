"""Voting: the rigid motion that most matches between a frame and a keyframe agree with.

On a floor seen from above, a true motion keeps every distance between points (rigid, of constant
scale); matches by chance do not.
"""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
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
    first, second = np.triu_indices(len(a), 1)
    base_a, base_b = a[second] - a[first], b[second] - b[first]
    length_a, length_b = np.hypot(*base_a.T), np.hypot(*base_b.T)
    slack = np.hypot(tolerance[first], tolerance[second])
    sound = (np.abs(length_a - length_b) < slack) & (length_a > _MIN_BASE * slack)
    pairs = np.flatnonzero(sound)
    if not len(pairs):
        return None
    # In the longest pairs, for their tolerance, the points' errors turn a motion least.
    pairs = pairs[np.argsort(-(length_a / slack)[pairs], kind="stable")[:_MAX_HYPOTHESES]]
    turns = np.arctan2(base_a[pairs, 1], base_a[pairs, 0])
    turns -= np.arctan2(base_b[pairs, 1], base_b[pairs, 0])
    middle_a = 0.5 * (a[first[pairs]] + a[second[pairs]])
    middle_b = 0.5 * (b[first[pairs]] + b[second[pairs]])
    residuals = _residuals(turns, middle_a, middle_b, a, b)
    inliers = residuals < tolerance
    votes = inliers.sum(axis=1)
    best = int(votes.argmax())
    pose, agree = Pose2(), inliers[best]
    for _ in range(_REFITS):
        if np.count_nonzero(agree) < MIN_VOTES:
            return None
        pose = fit_rigid_2d(a[agree], b[agree], 1.0 / tolerance[agree] ** 2)
        agree = np.hypot(*(pose.apply(b) - a).T) < tolerance
    count = int(np.count_nonzero(agree))
    return (pose, count) if count >= MIN_VOTES else None


def _residuals(
    turns: Float64Array,
    middle_a: Float64Array,
    middle_b: Float64Array,
    a: Float64Array,
    b: Float64Array,
) -> Float64Array:
    """Return (K, M) distances of matches under K motions, each by its turn and a pair of points."""
    cosine, sine = np.cos(turns)[:, None], np.sin(turns)[:, None]
    x = b[None, :, 0] - middle_b[:, :1]
    y = b[None, :, 1] - middle_b[:, 1:]
    away_x = cosine * x - sine * y + middle_a[:, :1] - a[None, :, 0]
    away_y = sine * x + cosine * y + middle_a[:, 1:] - a[None, :, 1]
    return np.hypot(away_x, away_y)
