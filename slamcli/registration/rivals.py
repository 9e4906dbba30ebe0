"""Rivals of a motion: others that a floor which looks like itself, or the prior, suggests.

A motion that fits is right only if no other motion fits as well. Where the floor repeats, the same
pixels fit one period on; where a motion contradicts the motion model, the
expected motion may fit too. Each rival is refined on the pixels of both views and counts until
pixels rule it out (patches that agree with the one motion alone), or the prior does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Pose2, squared_mahalanobis
from slamcli.registration import criteria
from slamcli.registration.hypothesis import (
    MotionHypothesis,
    PyramidPair,
    same_motion,
    score_refined,
)
from slamcli.stages import dense

# Squared Mahalanobis distance from the prior, 3 degrees of freedom: up to the first a motion is as
# expected (one in twenty is farther), from the second on the prior excludes it. A prior that is
# this far off one motion is no evidence against another
# [guarded by benchmarks/tiles.py; benchmarks/score.py: 16.3 accepts 11 false motions].
_MAX_EXPECTED = 7.8
_MIN_EXCLUDED = 36.0
# Of the rivals that a floor suggests, those followed, nearest first: a lattice has eight
# neighbours [guarded by benchmarks/tiles.py].
_MAX_RIVALS = 8


def is_expected(prior: dense.MotionPrior | None, pose: Pose2) -> bool:
    """Return whether a prior expects a motion; False without a prior."""
    return prior is not None and _distance(prior, pose) <= _MAX_EXPECTED


def is_surprising(prior: dense.MotionPrior | None, fit: MotionHypothesis) -> bool:
    """Return whether a measured motion is farther from the expected one than both sigmas allow."""
    if prior is None:
        return False
    covariance = prior.covariance + fit.predicted_covariance
    return squared_mahalanobis(prior.a_from_b, covariance, fit.pose) > _MAX_EXPECTED


def is_excluded(prior: dense.MotionPrior | None, pose: Pose2) -> bool:
    """Return whether a prior excludes a motion; False without a prior."""
    return prior is not None and _distance(prior, pose) >= _MIN_EXCLUDED


def starts(fit: Pose2, periods_a: Float64Array, periods_b: Float64Array) -> list[Pose2]:
    """Return the motions that look like a fit on a floor that looks like itself, nearest first.

    Parameters
    ----------
    fit : Pose2
        ``a_from_b``.
    periods_a, periods_b : (K, 2) float64
        Shifts, metres in each robot's axes, by which the views look like themselves.
    """
    shifts_a = [Pose2(float(x), float(y)) for x, y in (*periods_a, *-periods_a)]
    shifts_b = [Pose2(float(x), float(y)) for x, y in (*periods_b, *-periods_b)]
    shifted = [shift @ fit for shift in shifts_a] + [fit @ shift for shift in shifts_b]
    shifted.sort(key=lambda pose: (fit.inverse() @ pose).translation_length)
    return shifted


def refined(
    pair: PyramidPair, fit: MotionHypothesis, begun: Sequence[Pose2], calibration: Calibration
) -> Iterator[MotionHypothesis]:
    """Yield the rivals of a fit that refinement leads to from some starts, each once.

    Those are left out that leave much unexplained at half the resolution, where the fit leaves
    little: noise and blur count less there, and it takes a quarter of the time.
    """
    found: list[Pose2] = []
    tried: list[Pose2] = [fit.pose]
    coarse = PyramidPair(pair.a[1:], pair.b[1:])
    agreement = Deferred(partial(_agreement, coarse, fit.view_a_from_view_b))
    for start in begun:
        if len(found) == _MAX_RIVALS or any(same_motion(start, one, pair) for one in tried):
            continue
        tried.append(start)
        # All coarser levels at once: one alone may lead away from where the next would lead back
        # [benchmarks/tiles.py, 0.45 m and 3 marks: right motions were left out so].
        near = dense.refine(coarse.a, coarse.b, start, calibration, 0.0)
        if near is None or same_motion(near.a_from_b, fit.pose, pair):
            continue
        if criteria.explains_more(agreement.value, _agreement(coarse, near.view_a_from_view_b)):
            continue
        fine = dense.refine(pair.a[:2], pair.b[:2], near.a_from_b, calibration, 0.0)
        if fine is None or same_motion(fine.a_from_b, fit.pose, pair):
            continue
        if not any(same_motion(fine.a_from_b, other, pair) for other in found):
            found.append(fine.a_from_b)
            yield score_refined(pair, fine)


def _agreement(pair: PyramidPair, view_a_from_view_b: Float64Array) -> dense.Agreement:
    return dense.agreement(pair.a[0], pair.b[0], view_a_from_view_b)


def _distance(prior: dense.MotionPrior, pose: Pose2) -> float:
    return squared_mahalanobis(prior.a_from_b, prior.covariance, pose)
