"""Criteria of the photometric refinement: which fit is better, and what it leaves unexplained."""

from __future__ import annotations

import math
from dataclasses import dataclass

from slamcli.core.geometry import Pose2, squared_mahalanobis
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.stages import dense


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """Fixed numbers that decide which camera model a motion is refined with."""

    # A rigid motion that correlates this well needs no rocking camera to explain it, unless its
    # residuals suggest one [guarded by benchmarks/robustness.py: rocking on asphalt and planks].
    min_steady_correlation: float = 0.95
    # Noise lowers the correlation of normalised contrast on a bare floor; that of the gray values
    # less this counts there too [guarded by benchmarks/robustness.py: noise on bare].
    gray_correlation_handicap: float = 0.0475
    # What a fit with rocking may leave unexplained, as a share of what the fit without leaves.
    # Small where the residuals suggest no rocking: on a floor of few lines a tilt fits a line's end
    # as well as the motion does. Where they do, noise and blur, which rocking does not explain,
    # leave little between the two [guarded by benchmarks/robustness.py: rocking, course].
    max_unexplained_share: float = 0.6
    max_unexplained_share_if_suspected: float = 0.97
    # The widest rocking that is tried, in tilt sigmas, where the residuals suggest it [guarded by
    # tests/registration/test_dense.py: without it carpets come out 0.16 to 0.37 mm off].
    max_rocking_sigmas: float = 5.0
    # Share of the informative patches that must agree for the floor to dominate what is seen
    # [guarded by benchmarks/robustness.py: legs].
    min_floor_share: float = 0.5
    # Share of its overlap's variance that a rival must leave unexplained, and how many times what a
    # fit leaves, with this share of its overlap, to be ruled out. Tiles of one print leave up to
    # 0.15 one period on [guarded by tests/registration/test_rivals.py: squared paper, right
    # motions leave 0.06 to 0.29, wrong ones 0.53 to 0.58].
    min_unexplained_variance: float = 0.4
    min_unexplained_ratio: float = 2.0
    min_overlap_ratio: float = 0.4
    # What so many informative patches agree with leaves nothing of the floor unexplained: a lamp's
    # light alone, at the edge of a view, lowers the correlation of a narrow overlap
    # [guarded by benchmarks/tiles.py: 0.45 m].
    min_explained_share: float = 0.7
    # Features come this near to the truth, in pixels of the finest level and in radians: a fit
    # farther off follows obstacles [guarded by benchmarks/robustness.py: legs on bare].
    max_divergence_pixels: float = 2.0
    max_divergence_radians: float = math.radians(0.5)
    # And that far in their sigmas and the fit's, squared [benchmarks/robustness.py, legs on planks:
    # 294, and 7 mm off].
    max_squared_divergence: float = 50.0


SETTINGS = RefinementSettings()


def better(fit: MotionHypothesis, other: MotionHypothesis, *, rocking: bool) -> bool:
    """Return whether a fit is better than another, by evidence or by what it leaves unexplained.

    With rocking it must leave clearly less; where the residuals suggest rocking, a little less; and
    where they suggest more than is modelled already, anything less.
    """
    if not rocking:
        return fit.evidence > other.evidence
    share = SETTINGS.max_unexplained_share
    if other.rocking_suspected:
        share = 1.0 if other.includes_rocking else SETTINGS.max_unexplained_share_if_suspected
    return 1.0 - fit.correlation < share * (1.0 - other.correlation)


def diverged(start: Pose2, pose: Pose2, pair: PyramidPair) -> bool:
    """Return whether obstacles pulled a motion away from what the features measured."""
    moved = start.inverse() @ pose
    limit_metres = SETTINGS.max_divergence_pixels * pair.a[0].metres_per_pixel
    return (
        moved.translation_length > limit_metres
        or abs(moved.theta) > SETTINGS.max_divergence_radians
    )


def pulled_away(start: MotionHypothesis, fit: MotionHypothesis, pair: PyramidPair) -> bool:
    """Return whether what moves pulled a steady fit away from where features certainly put it.

    Legs before the floor have strong edges, and features on them agree with nothing.
    """
    if fit.includes_rocking or explains_all(fit) or not diverged(start.pose, fit.pose, pair):
        return False
    apart = squared_mahalanobis(start.pose, start.covariance + fit.covariance, fit.pose)
    return apart > SETTINGS.max_squared_divergence


def mostly_obstructed(fit: MotionHypothesis) -> bool:
    """Return whether most informative patches disagree with a fit, as obstacles make them do."""
    return fit.agreement.confirmed < SETTINGS.min_floor_share


def explains_more(fit: dense.Agreement, rival: dense.Agreement) -> bool:
    """Return whether a rival leaves much of its overlap unexplained, and a fit clearly less.

    By the agreement of the views' pixels under either.

    By variance: a pattern that repeats correlates, but not what is written over it. A rival of
    which a narrow strip fits does not explain more than a wide overlap.
    """
    shares_enough = fit.overlap >= SETTINGS.min_overlap_ratio * rival.overlap
    left = 1.0 - max(fit.correlation, 0.0) ** 2
    left_by_rival = 1.0 - max(rival.correlation, 0.0) ** 2
    least = max(SETTINGS.min_unexplained_variance, SETTINGS.min_unexplained_ratio * left)
    explained = rival.confirmed >= SETTINGS.min_explained_share
    return shares_enough and not explained and left_by_rival >= least


def explains_all(fit: MotionHypothesis) -> bool:
    """Return whether a fit leaves no disagreement that rocking or obstacles would explain."""
    return explained_by_steady_camera(fit) and not mostly_obstructed(fit)


def explained_by_steady_camera(fit: MotionHypothesis) -> bool:
    """Return whether a fit leaves no disagreement that rocking would explain."""
    correlation = max(
        fit.correlation, fit.agreement.correlation - SETTINGS.gray_correlation_handicap
    )
    return correlation >= SETTINGS.min_steady_correlation and not fit.rocking_suspected
