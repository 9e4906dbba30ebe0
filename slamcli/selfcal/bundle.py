"""What registered frames share, and which camera, poses and rocking explain it."""

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

_LEARNING_ROUNDS, _WARM_ROUNDS = 5, 1
# Frames this many places apart are compared too, where they share enough floor.
_NEIGHBOURS = 3
_MAX_MATCHES, _MAX_MATCHES_A_PAIR, _MIN_MATCHES_A_PAIR = 60_000, 200, 40
_MIN_PAIRS, _MIN_FRAMES = 4, 4
# One sigma at most of log focal length, two radial coefficients, pitch, roll and the principal
# point; the last only matters where it passes for a tilt, which has its own limit.
MAX_SIGMAS = np.array([0.01, 0.01, 0.05, math.radians(0.3), math.radians(0.3), 0.01, 0.01])
_MIN_LENS_SIGMAS = 4.0
_CORNER_RATIO = 0.3
_WITH_K1 = np.array([True, True, False, True, True, False, False])
_K2 = np.arange(7) == 2
_CENTRE = np.arange(7) >= 5
NONE = np.zeros(7, np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredDrive:
    """Frames registered with one calibration.

    Attributes
    ----------
    calibration : Calibration
    estimates : list of PoseEstimate
    links : list of Link
    switched_off : frozenset of int
        Places in `links` of those that the others contradict.
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
    """One round: what the frames share, and what explains it."""

    matches: list[adjustment.Matches]
    found: adjustment.Adjustment


def survey_frames(
    registration: RegisteredDrive, read: Read, in_order: InOrder, *, coarse: bool
) -> BundleRound | None:
    """Find what the frames share and what explains it; None when that is too little.

    The first time the foretold places are far off: what is found first tells where to look closely.
    """
    calibration = registration.calibration
    views = {
        estimate.index: adjustment.FramePose(estimate.map_from_robot, Rocking())
        for estimate in registration.estimates
        if estimate.map_from_robot is not None
    }
    pairs = _pairs(registration)
    if len(pairs) < _MIN_PAIRS or len(views) < _MIN_FRAMES:
        return None
    found: adjustment.Adjustment | None = None
    change = np.zeros(len(NONE))
    for coarsest in (adjustment.MAX_LEVEL, 1) if coarse else (1,):
        matcher = Matcher(calibration, views, registration.links, read, coarsest)
        share = min(_MAX_MATCHES // len(pairs), _MAX_MATCHES_A_PAIR)
        find = partial(matcher.match, count=max(share, _MIN_MATCHES_A_PAIR))
        matches = [match for match in in_order(find, pairs) if match is not None]
        if len(matches) < _MIN_PAIRS:
            return None
        rough = coarsest == adjustment.MAX_LEVEL
        found = _explain(calibration, views, matches, rough=rough)
        calibration, views = found.calibration, {**views, **found.views}
        change += found.camera_change
    assert found is not None
    return BundleRound(matches, replace(found, camera_change=change))


def fit(
    calibration: Calibration,
    views: Mapping[int, adjustment.FramePose],
    matches: Sequence[adjustment.Matches],
    camera_free: BoolArray,
    rocking_sigmas: Float64Array | None = None,
    rounds: int | None = None,
) -> adjustment.Adjustment:
    """Adjust; by how much frames rock is learnt, from what is given on or from the first guess."""
    warm = rocking_sigmas is not None
    sigmas = adjustment.FIRST_ROCKING if rocking_sigmas is None else rocking_sigmas
    if not np.any(sigmas):
        views = {i: adjustment.FramePose(v.map_from_robot, Rocking()) for i, v in views.items()}
    return adjustment.adjust(
        calibration,
        views,
        matches,
        _anchors(matches),
        camera_free=camera_free,
        rocking_sigmas=sigmas,
        learning_rounds=rounds or (_WARM_ROUNDS if warm else _LEARNING_ROUNDS),
    )


def median_pixels(found: adjustment.Adjustment, survey: BundleRound) -> float:
    """Return the median reprojection error of the spots that are known in both directions."""
    errors = []
    for match in survey.matches:
        there = adjustment.transfer(
            found.calibration, found.views[match.a], found.views[match.b], match.pixels_a
        )
        known = np.linalg.norm(match.whitening, axis=2)
        corner = known.min(axis=1) > _CORNER_RATIO * known.max(axis=1)
        errors.append(np.linalg.norm(there - match.pixels_b, axis=1)[corner])
    return float(np.median(np.concatenate(errors)))


def _explain(
    calibration: Calibration,
    views: Mapping[int, adjustment.FramePose],
    matches: Sequence[adjustment.Matches],
    *,
    rough: bool,
) -> adjustment.Adjustment:
    """Return the adjustment with as much of the lens as the matches determine."""
    plain = fit(calibration, views, matches, _WITH_K1, rounds=_WARM_ROUNDS if rough else None)
    loose = np.sqrt(np.diag(plain.camera_covariance)) > MAX_SIGMAS
    if rough or np.any(loose):
        return plain
    best, lens = plain, _WITH_K1
    # Each on its own merit: a centre that is off may tell more than another coefficient.
    for more in (_K2, _CENTRE):
        richer = fit(best.calibration, best.views, matches, lens | more, best.rocking_sigmas)
        sigmas = np.sqrt(np.diag(richer.camera_covariance))
        told = np.abs(richer.camera_change[more]) > _MIN_LENS_SIGMAS * sigmas[more]
        if not np.any(sigmas > MAX_SIGMAS) and np.any(told):
            change = best.camera_change + richer.camera_change
            best, lens = replace(richer, camera_change=change), lens | more
    return best


def _pairs(registration: RegisteredDrive) -> list[FramePair]:
    """Return the pairs of frames to compare: all that are linked, and near neighbours."""
    fragments = {
        e.index: e.fragment for e in registration.estimates if e.map_from_robot is not None
    }
    linked = {(min(link.a, link.b), max(link.a, link.b)) for link in registration.links}
    pairs = {pair for pair in linked if pair[0] in fragments and pair[1] in fragments}
    placed = sorted(fragments)
    for apart in range(1, _NEIGHBOURS + 1):
        pairs |= {
            (a, b)
            for a, b in zip(placed, placed[apart:], strict=False)
            if fragments[a] == fragments[b]
        }
    return sorted(pairs)


def _anchors(matches: Sequence[adjustment.Matches]) -> list[int]:
    """Return the first frame of each group that matches connect."""
    frames = sorted({pair.a for pair in matches} | {pair.b for pair in matches})
    places = {index: place for place, index in enumerate(frames)}
    rows = np.array([places[pair.a] for pair in matches])
    columns = np.array([places[pair.b] for pair in matches])
    graph = coo_matrix((np.ones(len(matches)), (rows, columns)), (len(frames), len(frames)))
    _, labels = connected_components(graph, directed=False)
    first = np.unique(labels, return_index=True)[1]
    return [frames[place] for place in first]
