"""The camera refines itself: what overlapping frames both see tells how it looks at the floor.

Frames are registered with the calibration as it is; from the spots that they share, camera, poses
and each frame's own tilt and height are estimated together (`stages.adjustment`), and the frames
are registered again with what came of it, until it stays the same. A camera is believed only when
the frames determine it, when it differs from the calibration by more than its own uncertainty, and
when it explains matches better that had no part in finding it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.stats import chi2

from slamcli.core.geometry import Pose2
from slamcli.core.records import Rocking
from slamcli.correspondences import Matcher, Pair, Read
from slamcli.stages import adjustment, camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.records import Calibration, FloorMap, Link, PoseEstimate

Matching = Callable[[Pair], adjustment.Matches | None]
InOrder = Callable[[Matching, Sequence[Pair]], Iterable[adjustment.Matches | None]]

_MOST_ROUNDS = 4
_LEARNING_ROUNDS, _WARM_ROUNDS = 5, 1
# Frames this many places apart are compared too, where they share enough floor.
_NEIGHBOURS = 3
_MOST_MATCHES, _MOST_MATCHES_A_PAIR, _LEAST_MATCHES_A_PAIR = 60_000, 200, 40
_LEAST_PAIRS, _LEAST_FRAMES = 4, 4
_HELD_OUT = 4
# One sigma at most of log focal length, two radial coefficients, pitch, roll and the principal
# point; the last only matters where it passes for a tilt, which has its own limit.
_MOST_SIGMAS = np.array([0.003, 0.01, 0.05, math.radians(0.1), math.radians(0.1), 0.01, 0.01])
_LEAST_LENS_SIGMAS = 4.0
_SIGNIFICANCE = 0.999
# A better camera leaves less than this share of the error of matches that it was not made from;
# what is off by more than so many sigmas is no match.
_MOST_OF_BEFORE = 0.995
_CLIPPED = 5.0
_CORNER_RATIO = 0.3
# A round that moves the camera by less than this many sigmas, or this little, was the last.
_SETTLED_SIGMAS = 1.0
_SETTLED = np.array([2e-5, 2e-5, 2e-5, 2e-6, 2e-6, 2e-6, 2e-6])
# A pose is no surer than this, m and rad.
_LEAST_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])
_TILTS_AND_FOCAL = np.array([True, False, False, True, True, False, False])
_WITH_K1 = np.array([True, True, False, True, True, False, False])
_WITH_K2 = np.array([True, True, True, True, True, False, False])
_WITH_CENTRE = np.ones(7, np.bool_)
_NONE = np.zeros(7, np.bool_)


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
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
class Refinement:
    """What came of it.

    Attributes
    ----------
    registration : Registration
        With refined camera and poses where they are believed, else as it was given.
    verdict : str
        ``refined``, ``confirmed`` (the calibration is right; poses refined), or ``not applied``.
    reason : str
        In words.
    rounds : int
    pixels_before, pixels_after : float
        Median distance between where a spot is seen and where the camera and the poses put it, of
        spots known in both directions; with the calibration's camera and without rocking, and as
        refined. Nan when not measured.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and height (as a share) vary from frame to frame.
    """

    registration: Registration
    verdict: str
    reason: str
    rounds: int = 0
    pixels_before: float = math.nan
    pixels_after: float = math.nan
    rocking_sigmas: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Survey:
    """One round: what the frames share, and what explains it."""

    matches: list[adjustment.Matches]
    found: adjustment.Adjustment


def refine(
    first: Registration,
    read: Read,
    register: Callable[[Calibration], Registration],
    in_order: InOrder,
    true_scale: Callable[[Calibration], float],
) -> Refinement:
    """Refine camera and poses from the frames themselves, if they determine them.

    Parameters
    ----------
    first : Registration
        With the calibration as it is.
    read : callable
        Returns a frame by its index; may raise FrameError.
    register : callable
        Registers all frames anew with another calibration.
    in_order : callable
        Like `map`; may work ahead.
    true_scale : callable
        By how much a camera's height is to be multiplied for what the calibration was made from to
        keep its size.
    """
    if not math.isfinite(first.calibration.height_metres):
        return Refinement(first, "not applied", "there is no calibration to refine")
    survey = _survey(first, read, in_order, coarse=True)
    if survey is None:
        return Refinement(first, "not applied", "too few frames share floor")
    doubt = _left_open(survey.found)
    if doubt:
        return Refinement(first, "not applied", doubt, 1)
    views, matches = survey.found.views, survey.matches
    held = _fit(first.calibration, views, matches, _NONE, survey.found.rocking_sigmas)
    rigid = _fit(first.calibration, views, matches, _NONE, rocking_sigmas=np.zeros(3))
    before = _median_pixels(rigid, survey)
    confirmed = _confirmed(first.calibration, survey)
    if confirmed:
        done = _with_views(first, held, 1.0)
        after = _median_pixels(held, survey)
        return Refinement(done, "confirmed", confirmed, 1, before, after, held.rocking_sigmas)
    current, rounds = first, 1
    while rounds < _MOST_ROUNDS and not (rounds > 1 and _settled(survey.found)):
        registered = register(_with_range(first.calibration, survey.found.calibration))
        if _placed(registered) < _placed(first):
            reason = f"the refined camera places {_placed(registered)} frames of {_placed(first)}"
            return Refinement(first, "not applied", reason, rounds)
        again = _survey(registered, read, in_order, coarse=False)
        if again is None or _left_open(again.found):
            break
        current, survey, rounds = registered, again, rounds + 1
    found = survey.found
    done = _with_views(current, found, true_scale(found.calibration))
    return Refinement(
        done,
        "refined",
        _told(first.calibration, done.calibration),
        rounds,
        before,
        _median_pixels(found, survey),
        found.rocking_sigmas,
    )


def _survey(
    registration: Registration, read: Read, in_order: InOrder, *, coarse: bool
) -> _Survey | None:
    """Find what the frames share and what explains it; None when that is too little.

    The first time the foretold places are far off: what is found first tells where to look closely.
    """
    calibration = registration.calibration
    views = {
        estimate.index: adjustment.View(estimate.map_from_robot, Rocking())
        for estimate in registration.estimates
        if estimate.map_from_robot is not None
    }
    pairs = _pairs(registration)
    if len(pairs) < _LEAST_PAIRS or len(views) < _LEAST_FRAMES:
        return None
    found: adjustment.Adjustment | None = None
    change = np.zeros(len(_NONE))
    for coarsest in (adjustment.DEEPEST_LEVEL, 1) if coarse else (1,):
        matcher = Matcher(calibration, views, registration.links, read, coarsest)
        share = min(_MOST_MATCHES // len(pairs), _MOST_MATCHES_A_PAIR)
        find = partial(matcher.match, count=max(share, _LEAST_MATCHES_A_PAIR))
        matches = [match for match in in_order(find, pairs) if match is not None]
        if len(matches) < _LEAST_PAIRS:
            return None
        rough = coarsest == adjustment.DEEPEST_LEVEL
        found = _explain(calibration, views, matches, rough=rough)
        calibration, views = found.calibration, {**views, **found.views}
        change += found.camera_change
    assert found is not None
    return _Survey(matches, replace(found, camera_change=change))


def _explain(
    calibration: Calibration,
    views: Mapping[int, adjustment.View],
    matches: Sequence[adjustment.Matches],
    *,
    rough: bool,
) -> adjustment.Adjustment:
    """Return the adjustment with as much of the lens as the matches determine."""
    plain = _fit(calibration, views, matches, _WITH_K1, rounds=_WARM_ROUNDS if rough else None)
    if rough:
        return plain
    if math.sqrt(plain.camera_covariance[1, 1]) > _MOST_SIGMAS[1]:
        return _fit(calibration, views, matches, _TILTS_AND_FOCAL)
    best = plain
    for more, free in ((slice(2, 3), _WITH_K2), (slice(5, 7), _WITH_CENTRE)):
        richer = _fit(best.calibration, best.views, matches, free, best.rocking_sigmas)
        sigmas = np.sqrt(np.diag(richer.camera_covariance))
        told = np.abs(richer.camera_change[more]) > _LEAST_LENS_SIGMAS * sigmas[more]
        if np.any(sigmas > _MOST_SIGMAS) or not np.any(told):
            break
        best = replace(richer, camera_change=best.camera_change + richer.camera_change)
    return best


def _fit(
    calibration: Calibration,
    views: Mapping[int, adjustment.View],
    matches: Sequence[adjustment.Matches],
    camera_free: NDArray[np.bool_],
    rocking_sigmas: NDArray[np.float64] | None = None,
    rounds: int | None = None,
) -> adjustment.Adjustment:
    """Adjust; by how much frames rock is learnt, from what is given on or from the first guess."""
    warm = rocking_sigmas is not None
    sigmas = adjustment.FIRST_ROCKING if rocking_sigmas is None else rocking_sigmas
    if not np.any(sigmas):
        views = {i: adjustment.View(v.map_from_robot, Rocking()) for i, v in views.items()}
    return adjustment.adjust(
        calibration,
        views,
        matches,
        _anchors(matches),
        camera_free=camera_free,
        rocking_sigmas=sigmas,
        learning_rounds=rounds or (_WARM_ROUNDS if warm else _LEARNING_ROUNDS),
    )


def _pairs(registration: Registration) -> list[Pair]:
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


def _left_open(found: adjustment.Adjustment) -> str:
    """Return which of focal length, pitch and roll the frames leave open; empty when none."""
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    words = (
        f"the focal length (±{sigmas[0]:.1%})",
        "",
        "",
        f"the pitch (±{math.degrees(sigmas[3]):.2g}°)",
        f"the roll (±{math.degrees(sigmas[4]):.2g}°)",
        "",
        "",
    )
    loose = [
        word
        for word, sigma, most in zip(words, sigmas, _MOST_SIGMAS, strict=True)
        if word and sigma > most
    ]
    if not loose:
        return ""
    return f"the frames leave open {', '.join(loose)}; drive turns, and let frames overlap more"


def _confirmed(calibration: Calibration, survey: _Survey) -> str:
    """Return why the calibration is as good as what was found; empty when it is not."""
    found = survey.found
    free = np.diag(found.camera_covariance) > 0.0
    change = found.camera_change[free]
    distance = float(change @ np.linalg.solve(found.camera_covariance[np.ix_(free, free)], change))
    if distance < chi2.ppf(_SIGNIFICANCE, len(change)):
        return "what the frames say differs from the calibration by no more than its uncertainty"
    told = [_part(match, held_out=False) for match in survey.matches]
    asked = [_part(match, held_out=True) for match in survey.matches]
    errors = []
    for judged in (calibration, found.calibration):
        fit = _fit(judged, found.views, told, _NONE, found.rocking_sigmas)
        lengths = adjustment.residual_lengths(fit.calibration, fit.views, asked)
        errors.append(float(np.mean(np.minimum(lengths, _CLIPPED * found.scale))))
    if errors[1] > _MOST_OF_BEFORE * errors[0]:
        return "another camera would explain matches that it was not made from no better"
    return ""


def _part(match: adjustment.Matches, *, held_out: bool) -> adjustment.Matches:
    """Return every fourth of a pair's matches, or the others."""
    chosen = (np.arange(len(match)) % _HELD_OUT == 0) == held_out
    return replace(
        match,
        pixels_a=match.pixels_a[chosen],
        pixels_b=match.pixels_b[chosen],
        whitening=match.whitening[chosen],
    )


def _settled(found: adjustment.Adjustment) -> bool:
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    return bool(
        np.all(np.abs(found.camera_change) <= np.maximum(_SETTLED_SIGMAS * sigmas, _SETTLED))
    )


def _placed(registration: Registration) -> int:
    return sum(estimate.map_from_robot is not None for estimate in registration.estimates)


def _with_range(before: Calibration, calibration: Calibration) -> Calibration:
    """Return the calibration with its far limit moved as its view of the floor has."""
    chosen = [
        camera.choose_max_range(c.camera_matrix, c.image_from_robot, c.image_size)
        for c in (before, calibration)
    ]
    return replace(calibration, max_range_metres=before.max_range_metres * chosen[1] / chosen[0])


def _median_pixels(found: adjustment.Adjustment, survey: _Survey) -> float:
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


def _with_views(
    registration: Registration, found: adjustment.Adjustment, scale: float
) -> Registration:
    """Return the registration with adjusted camera and poses, its lengths multiplied by `scale`.

    A frame without matches of its own moves with the nearest that has some.
    """
    calibration = _scaled_camera(found, registration.calibration, scale)
    before = {e.index: e for e in registration.estimates if e.map_from_robot is not None}
    estimates = []
    for estimate in registration.estimates:
        if estimate.map_from_robot is None:
            estimates.append(estimate)
            continue
        rocking, covariance = Rocking(), estimate.covariance
        if estimate.index in found.views:
            pose = found.views[estimate.index].map_from_robot
            rocking = found.views[estimate.index].rocking
            covariance = found.pose_covariances[estimate.index] + _LEAST_POSE_COVARIANCE
        else:
            pose = _carried(estimate, before, found)
        metres = np.array([scale, scale, 1.0])
        estimates.append(
            replace(
                estimate,
                map_from_robot=Pose2(scale * pose.x, scale * pose.y, pose.theta),
                covariance=None if covariance is None else covariance * np.outer(metres, metres),
                rocking=replace(rocking, height_metres=scale * rocking.height_metres),
            )
        )
    by_index = {estimate.index: estimate for estimate in estimates}
    floor_map = registration.floor_map
    if floor_map is not None:
        kept = tuple(by_index[estimate.index] for estimate in floor_map.estimates)
        links = tuple(_scaled(link, scale) for link in floor_map.links)
        floor_map = replace(floor_map, calibration=calibration, estimates=kept, links=links)
    return replace(registration, calibration=calibration, estimates=estimates, floor_map=floor_map)


def _carried(
    estimate: PoseEstimate, before: Mapping[int, PoseEstimate], found: adjustment.Adjustment
) -> Pose2:
    """Return a frame's pose moved as the nearest adjusted frame of its map was."""
    assert estimate.map_from_robot is not None
    same = [i for i in found.views if before[i].fragment == estimate.fragment]
    if not same:
        return estimate.map_from_robot
    nearest = min(same, key=lambda index: (abs(index - estimate.index), index))
    known = before[nearest].map_from_robot
    assert known is not None
    return found.views[nearest].map_from_robot @ known.inverse() @ estimate.map_from_robot


def _scaled_camera(found: adjustment.Adjustment, before: Calibration, scale: float) -> Calibration:
    """Return the adjusted camera with its height scaled and its sigmas filled in."""
    calibration = _with_range(before, found.calibration)
    height = scale * calibration.height_metres
    if not np.any(found.camera_covariance):
        return before
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    return replace(
        calibration,
        height_metres=height,
        max_range_metres=scale * calibration.max_range_metres,
        robot_from_image=camera.compose_robot_from_image(
            calibration.camera_matrix, height, calibration.pitch_radians, calibration.roll_radians
        ),
        height_sigma_metres=scale * before.height_sigma_metres,
        focal_sigma_pixels=float(sigmas[0] * calibration.camera_matrix[0, 0]),
        pitch_sigma_radians=float(sigmas[3]),
        roll_sigma_radians=float(sigmas[4]),
    )


def _told(before: Calibration, after: Calibration) -> str:
    focal = [c.camera_matrix[0, 0] for c in (before, after)]
    height = [1000.0 * c.height_metres for c in (before, after)]
    pitch = [math.degrees(c.pitch_radians) for c in (before, after)]
    roll = [math.degrees(c.roll_radians) for c in (before, after)]
    lens = [", ".join(f"{k:.4f}" for k in c.distortion[:2]) for c in (before, after)]
    centre = after.camera_matrix[:2, 2] - before.camera_matrix[:2, 2]
    return (
        f"focal length {focal[0]:.1f} to {focal[1]:.1f} ± {after.focal_sigma_pixels:.1f} px, "
        f"radial distortion {lens[0]} to {lens[1]}, "
        f"principal point moved by {centre[0]:.1f}, {centre[1]:.1f} px, "
        f"height {height[0]:.1f} to {height[1]:.1f} mm, "
        f"pitch {pitch[0]:.2f} to {pitch[1]:.2f} ± {math.degrees(after.pitch_sigma_radians):.2g}°, "
        f"roll {roll[0]:.2f} to {roll[1]:.2f} ± {math.degrees(after.roll_sigma_radians):.2g}°"
    )


def _scaled(link: Link, scale: float) -> Link:
    """Return a link in metres that are so many times the ones that it was measured in."""
    motion, metres = link.a_from_b, np.array([scale, scale, 1.0])
    return replace(
        link,
        a_from_b=Pose2(scale * motion.x, scale * motion.y, motion.theta),
        covariance=link.covariance * np.outer(metres, metres),
    )
