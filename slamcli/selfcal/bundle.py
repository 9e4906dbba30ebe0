"""One round of self-calibration: correspondences of registered frames, and their adjustment."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.records import FloorMap, Link, PoseEstimate
from slamcli.selfcal.correspondences import FramePair, Matcher, Read
from slamcli.stages import adjustment

Matching = Callable[[FramePair], adjustment.Matches | None]
InOrder = Callable[[Matching, Sequence[FramePair]], Iterable[adjustment.Matches | None]]

# Iterations of expectation maximisation for the sigmas of the rocking, from their first guess and
# from an estimate. [All thresholds here are guarded by benchmarks/self_calibration.py.]
_LEARNING_ROUNDS, _WARM_ROUNDS = 5, 1
_MAX_MATCHES, _MIN_MATCHES_A_PAIR = 60_000, 40
_MIN_PAIRS, _MIN_FRAMES = 4, 4
# Largest sigmas of log focal length, two radial coefficients, pitch, roll and the principal point
# of an observable camera; the last only matters where it is confused with a tilt, which has its
# own limit.
MAX_SIGMAS = np.array([0.01, 0.01, 0.05, math.radians(0.3), math.radians(0.3), 0.01, 0.01])
# A further lens parameter is kept when it differs from its prior by this many sigmas.
_MIN_LENS_SIGMAS = 4.0
# A match whose one direction is known this much better than the other lies on a line.
_CORNER_RATIO = 0.3
# Which of the seven camera parameters are estimated.
_WITH_K1 = np.array([True, True, False, True, True, False, False])
_K2 = np.arange(7) == 2
_CENTRE = np.arange(7) >= 5
NONE = np.zeros(7, np.bool_)


@dataclass(frozen=True, slots=True)
class Effort:
    """How much a self-calibration may cost.

    Attributes
    ----------
    neighbours : int
        Besides linked frames those up to this far apart in the sequence are compared, where they
        overlap.
    matches_a_pair : int
    rounds : int
        Of registration and adjustment, at most.
    """

    neighbours: int
    matches_a_pair: int
    rounds: int


THOROUGH = Effort(neighbours=3, matches_a_pair=200, rounds=4)
# About as much again as the registration: frames are registered anew only where some are lost.
BRIEF = Effort(neighbours=2, matches_a_pair=40, rounds=2)


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredDrive:
    """A drive registered with one calibration.

    Attributes
    ----------
    calibration : Calibration
    estimates : list of PoseEstimate
    links : list of Link
    switched_off : frozenset of int
        Indices in `links` of those that the others contradict.
    floor_map : FloorMap or None
        None while nothing is placed.
    """

    calibration: Calibration
    estimates: list[PoseEstimate]
    links: list[Link]
    switched_off: frozenset[int] = frozenset()
    floor_map: FloorMap | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BundleRound:
    """Result of one round: the correspondences, and the adjustment that explains them."""

    matches: list[adjustment.Matches]
    found: adjustment.Adjustment


def adjust_drive(
    drive: RegisteredDrive,
    read: Read,
    in_order: InOrder,
    effort: Effort,
    before: adjustment.Adjustment | None = None,
) -> BundleRound | None:
    """Return the correspondences of a drive and their adjustment; None when too few frames overlap.

    Parameters
    ----------
    drive : RegisteredDrive
    read : callable
        Returns a frame by its index; may raise FrameError.
    in_order : callable
        Like `map`; may work ahead.
    effort : Effort
    before : Adjustment or None
        Of the round before, from which the drive's camera is. Without one, predicted matches may be
        far off: then fewer, from a coarse pyramid level on, are adjusted first to predict the
        others.
    """
    calibration = drive.calibration
    poses = {
        estimate.index: adjustment.FramePose(estimate.map_from_robot, Rocking())
        for estimate in drive.estimates
        if estimate.map_from_robot is not None
    }
    pairs = _pairs(drive, effort.neighbours)
    if len(pairs) < _MIN_PAIRS or len(poses) < _MIN_FRAMES:
        return None
    found: adjustment.Adjustment | None = None
    change = np.zeros(len(NONE))
    sigmas = None if before is None else before.rocking_sigmas
    share = max(min(_MAX_MATCHES // len(pairs), effort.matches_a_pair), _MIN_MATCHES_A_PAIR)
    for coarsest in (adjustment.MAX_LEVEL, 1) if before is None else (1,):
        rough = coarsest == adjustment.MAX_LEVEL
        matcher = Matcher(calibration, poses, drive.links, read, coarsest)
        find = partial(matcher.match, count=_MIN_MATCHES_A_PAIR if rough else share)
        matches = [match for match in in_order(find, pairs) if match is not None]
        if len(matches) < _MIN_PAIRS:
            return None
        found = _adjust_camera(calibration, poses, matches, sigmas, rough=rough)
        calibration, poses = found.calibration, {**poses, **found.poses}
        change += found.camera_change
    assert found is not None
    return BundleRound(matches, replace(found, camera_change=change))


def fit(
    calibration: Calibration,
    poses: Mapping[int, adjustment.FramePose],
    matches: Sequence[adjustment.Matches],
    camera_free: BoolArray,
    rocking_sigmas: Float64Array | None = None,
    rounds: int | None = None,
) -> adjustment.Adjustment:
    """Return the adjustment of some of the camera's parameters, the poses and the rocking.

    Parameters
    ----------
    camera_free : (7,) bool
        Which camera parameters are estimated, see `adjustment.adjust`.
    rocking_sigmas : (3,) float64 or None
        Start of their estimation; zeros for a camera that does not rock, None for a first guess.
    rounds : int or None
        Iterations of that estimation; None for enough from such a start.
    """
    warm = rocking_sigmas is not None
    sigmas = adjustment.INITIAL_ROCKING_SIGMAS if rocking_sigmas is None else rocking_sigmas
    if not np.any(sigmas):
        poses = {i: adjustment.FramePose(p.map_from_robot, Rocking()) for i, p in poses.items()}
    return adjustment.adjust(
        calibration,
        poses,
        matches,
        _anchors(matches),
        camera_free=camera_free,
        rocking_sigmas=sigmas,
        learning_rounds=rounds or (_WARM_ROUNDS if warm else _LEARNING_ROUNDS),
    )


def median_pixels(found: adjustment.Adjustment, matches: Sequence[adjustment.Matches]) -> float:
    """Return the median reprojection error of the matches that are known in both directions."""
    errors = []
    for match in matches:
        there = adjustment.transfer(
            found.calibration, found.poses[match.a], found.poses[match.b], match.pixels_a
        )
        precision = np.linalg.norm(match.whitening, axis=2)
        corner = precision.min(axis=1) > _CORNER_RATIO * precision.max(axis=1)
        errors.append(np.linalg.norm(there - match.pixels_b, axis=1)[corner])
    return float(np.median(np.concatenate(errors)))


def _adjust_camera(
    calibration: Calibration,
    poses: Mapping[int, adjustment.FramePose],
    matches: Sequence[adjustment.Matches],
    sigmas: Float64Array | None,
    *,
    rough: bool,
) -> adjustment.Adjustment:
    """Return the adjustment with every lens parameter that the matches determine.

    The estimation of the rocking's sigmas starts from those given, or from a first guess.
    """
    rounds = _WARM_ROUNDS if rough else None
    plain = fit(calibration, poses, matches, _WITH_K1, sigmas, rounds)
    loose = np.sqrt(np.diag(plain.camera_covariance)) > MAX_SIGMAS
    if rough or np.any(loose):
        return plain
    best, lens = plain, _WITH_K1
    # Each on its own evidence: a principal point off the centre may explain more than k2.
    for more in (_K2, _CENTRE):
        richer = fit(best.calibration, best.poses, matches, lens | more, best.rocking_sigmas)
        sigmas = np.sqrt(np.diag(richer.camera_covariance))
        significant = np.abs(richer.camera_change[more]) > _MIN_LENS_SIGMAS * sigmas[more]
        if not np.any(sigmas > MAX_SIGMAS) and np.any(significant):
            change = best.camera_change + richer.camera_change
            best, lens = replace(richer, camera_change=change), lens | more
    return best


def _pairs(drive: RegisteredDrive, neighbours: int) -> list[FramePair]:
    """Return the pairs of frames to compare: all that are linked, and near neighbours."""
    fragments = {e.index: e.fragment for e in drive.estimates if e.map_from_robot is not None}
    linked = {(min(link.a, link.b), max(link.a, link.b)) for link in drive.links}
    pairs = {pair for pair in linked if pair[0] in fragments and pair[1] in fragments}
    placed = sorted(fragments)
    for apart in range(1, neighbours + 1):
        pairs |= {
            (a, b)
            for a, b in zip(placed, placed[apart:], strict=False)
            if fragments[a] == fragments[b]
        }
    return sorted(pairs)


def _anchors(matches: Sequence[adjustment.Matches]) -> list[int]:
    """Return the first frame of each group that matches connect."""
    frames = sorted({pair.a for pair in matches} | {pair.b for pair in matches})
    positions = {index: position for position, index in enumerate(frames)}
    rows = np.array([positions[pair.a] for pair in matches])
    columns = np.array([positions[pair.b] for pair in matches])
    graph = coo_matrix((np.ones(len(matches)), (rows, columns)), (len(frames), len(frames)))
    _, labels = connected_components(graph, directed=False)
    first = np.unique(labels, return_index=True)[1]
    return [frames[position] for position in first]
