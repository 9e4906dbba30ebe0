"""A survey: features of all frames in, every frame's state over the plane out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from slamcli.survey import candidates
from slamcli.survey.bundle import ALL_MATCHES, Bundle, LensFree, adjust
from slamcli.survey.candidates import NumberPair
from slamcli.survey.false_pairs import contradicted_overlaps, least_correlated, overlaps
from slamcli.survey.features import SurveyFeatures
from slamcli.survey.in_order import InOrder
from slamcli.survey.lens import Lens, Mount
from slamcli.survey.network import connected, first_states, rescaled
from slamcli.survey.pairs import Pair, coarse_votes, find_pair
from slamcli.survey.slanted import VIEWS, slanted_pairs
from slamcli.survey.uncertainty import learned_mount

# Rounds of matching what the poses predict to overlap, of leaving out contradicted pairs, and of
# learning how freely the camera moves. [Guarded by benchmarks/real_sets.py.]
_OVERLAP_ROUNDS, _OUTLIER_ROUNDS, _LEARNING_ROUNDS = 2, 4, 4
# A pair is contradicted by the others when its median residual is this many times the pairs' own
# median, and this share of the picture's longer side.
_OUTLIER_FACTOR, _OUTLIER_SHARE = 5.0, 0.008
# Frames with fewer points are not looked at again from a slant.
_MIN_POINTS = 100
# The focal length is estimated, with a mount so many times looser, where the pairs' median residual
# is then at most this many times that of a homography for each pair, and was before or falls to
# this share [benchmarks/real_sets.py: 1.5 to 2.5 times over seabeds with relief, where it would be
# 0.1 to 0.3 widths; 1.3 times, and half as much as before, from a drone in the wind;
# tests/survey/test_survey.py: photos tilted by 23 degrees, 0.25 times as much as before].
_MAX_EXPLAINED_FACTOR, _MAX_FALLEN_SHARE, _LOOSER = 1.4, 0.75, 3.0
_FIRST_MOUNT, _LOOSE_MOUNT = Mount(0.0, 0.3), Mount(0.005, 0.3)
# The features of tilted views of a frame, by its number.
Slanted = Callable[[int], Sequence[SurveyFeatures]]


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMap:
    """One connected map: its frames, the adjustment of their states, and the pairs it used."""

    frames: tuple[int, ...]
    bundle: Bundle
    pairs: tuple[Pair, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Result of a survey.

    Attributes
    ----------
    maps : tuple of SurveyMap
        The largest first; each of two frames or more.
    contradicted : tuple of Pair
        Verified pairs that the others of their map contradict.
    rejected : tuple of Pair
        Of the others that were matched, with their reasons.
    """

    maps: tuple[SurveyMap, ...]
    contradicted: tuple[Pair, ...]
    rejected: tuple[Pair, ...]


def survey(
    features: Sequence[SurveyFeatures],
    lens: Lens,
    in_order: InOrder = map,
    *,
    level: bool = False,
    slanted: Slanted | None = None,
) -> Survey:
    """Return the maps that frames connect to.

    Parameters
    ----------
    features : sequence of SurveyFeatures
        Of every frame; those of a frame that cannot be used have no points.
    lens : Lens
        First guess.
    in_order : callable
        Like `map`; may work ahead.
    level : bool
        The camera does not tilt, as on a gimbal.
    slanted : callable or None
        Of a frame that fits no other: features of tilted views of it, see `slanted`.
    """
    frames = len(features)
    compared = candidates.compared(frames)
    votes = list(in_order(partial(_votes, features), compared))
    first = [*candidates.by_sequence(frames), *candidates.by_appearance(compared, votes)]
    tried: set[NumberPair] = set()
    pairs, rejected, contradicted = list[Pair](), list[Pair](), list[Pair]()
    following = candidates.untried(first, tried)
    maps: list[SurveyMap] = []
    for _ in range(1 + _OVERLAP_ROUNDS):
        tried |= set(following)
        found = list(in_order(partial(_pair, features), following))
        rejected += [pair for pair in found if pair.reason]
        new = [pair for pair in found if not pair.reason]
        if maps and not new:
            break
        maps, off = _without_false([*pairs, *new], features, lens, level=level)
        contradicted += off
        pairs = [pair for one in maps for pair in one.pairs]
        predicted = [pair for one in maps for pair in overlaps(one.bundle, one.frames, features)]
        following = candidates.untried(predicted, tried)
        if not following:
            break
    if slanted is not None:
        new = _slanted_pairs(maps, features, slanted, in_order)
        if new:
            maps, off = _without_false([*pairs, *new], features, lens, level=level)
            contradicted += off
    return Survey(tuple(maps), tuple(contradicted), tuple(rejected))


def _slanted_pairs(
    maps: Sequence[SurveyMap],
    features: Sequence[SurveyFeatures],
    slanted: Slanted,
    in_order: InOrder,
) -> list[Pair]:
    """Return pairs of frames that are in no map, by tilted views of them.

    Of so few frames that it takes at most about as long as all frames took to describe.
    """
    placed = {frame for one in maps for frame in one.frames}
    left = [n for n, one in enumerate(features) if n not in placed and len(one) >= _MIN_POINTS]
    if not maps or len(left) > -(-len(features) // VIEWS):
        return []

    def found(frame: int) -> list[Pair]:
        return slanted_pairs(frame, slanted(frame), features)

    return [pair for some in in_order(found, left) for pair in some]


def _votes(features: Sequence[SurveyFeatures], numbers: NumberPair) -> int:
    a, b = numbers
    return coarse_votes(features[a], features[b])


def _pair(features: Sequence[SurveyFeatures], numbers: NumberPair) -> Pair:
    a, b = numbers
    return find_pair(a, b, features[a], features[b])


def _without_false(
    pairs: Sequence[Pair], features: Sequence[SurveyFeatures], lens: Lens, *, level: bool
) -> tuple[list[SurveyMap], list[Pair]]:
    """Return the maps that pairs connect, and the pairs that other pairs or pixels contradict.

    False pairs may be more than true ones, and contradict them: without them all others count.
    """
    false = list[Pair]()
    while True:
        left = [pair for pair in pairs if pair not in false]
        maps, contradicted = _solve(left, len(features), lens, level=level)
        found = [_false_pair(one, contradicted, features) for one in maps]
        if not any(found):
            return maps, [*contradicted, *false]
        false += [pair for pair in found if pair is not None]


def _false_pair(
    one: SurveyMap, contradicted: Sequence[Pair], features: Sequence[SurveyFeatures]
) -> Pair | None:
    """Return a false pair of a map, by its overlaps and by the pairs that it contradicts."""
    overlapping = contradicted_overlaps(one.bundle, one.frames, one.pairs, features)
    return least_correlated(one.pairs, overlapping, contradicted)


def _solve(
    pairs: Sequence[Pair], frames: int, lens: Lens, *, level: bool
) -> tuple[list[SurveyMap], list[Pair]]:
    """Return the maps that pairs connect, and the pairs that the others contradict."""
    maps, contradicted = [], list[Pair]()
    left = [members for members in connected(pairs, frames) if len(members) > 1]
    while left:
        members = left.pop(0)
        inside = set(members)
        own = [pair for pair in pairs if pair.a in inside and pair not in contradicted]
        solved, off = _solve_connected(own, members, lens, level=level)
        contradicted += off
        if solved is None:
            parts = connected([pair for pair in own if pair not in off], frames)
            left += [part for part in parts if len(part) > 1 and part[0] in inside]
        else:
            maps.append(solved)
    maps.sort(key=lambda one: (-len(one.frames), one.frames[0]))
    return [*maps[:1], *(_with_lens(one, maps[0].bundle.lens) for one in maps[1:])], contradicted


def _with_lens(one: SurveyMap, lens: Lens) -> SurveyMap:
    """Return a small map adjusted anew with the lens of the largest, which determines it better."""
    states, mount = one.bundle.states, one.bundle.mount
    bundle = adjust(one.pairs, one.frames, states, lens, mount, lens_free="none")
    return replace(one, bundle=_sharpened(bundle, one.pairs, one.frames, "none"))


def _sharpened(
    bundle: Bundle,
    pairs: Sequence[Pair],
    frames: Sequence[int],
    lens_free: LensFree = "bend",
) -> Bundle:
    """Return a bundle adjusted to all matches with its own mount; its information stays."""
    states, lens, mount = rescaled(bundle.states), bundle.lens, bundle.mount
    sharp = adjust(pairs, frames, states, lens, mount, lens_free=lens_free, independent=ALL_MATCHES)
    return replace(
        sharp,
        states=rescaled(sharp.states),
        information=bundle.information,
        free=bundle.free,
        noise_pixels=bundle.noise_pixels,
    )


def _solve_connected(
    pairs: list[Pair], members: list[int], lens: Lens, *, level: bool
) -> tuple[SurveyMap | None, list[Pair]]:
    """Return the map of connected frames, and the pairs left out.

    None for the map when these hold it together: its parts are to be solved by themselves.
    """
    contradicted = list[Pair]()
    states = first_states(pairs, members, lens)
    for _ in range(_OUTLIER_ROUNDS):
        bundle = adjust(pairs, members, states, lens, _FIRST_MOUNT)
        loose = _FIRST_MOUNT if level else _LOOSE_MOUNT
        bundle = adjust(pairs, members, rescaled(bundle.states), bundle.lens, loose)
        for _ in range(_LEARNING_ROUNDS):
            states = rescaled(bundle.states)
            mount = learned_mount(bundle)
            mount = replace(mount, tilt_sigma=0.0) if level else mount
            bundle = adjust(pairs, members, states, bundle.lens, mount)
        off = _outliers(bundle, pairs)
        if not off:
            break
        contradicted += off
        pairs = [pair for pair in pairs if pair not in off]
        parts = connected(pairs, max(members) + 1)
        if len(parts[0]) < len(members):
            return None, contradicted
    bundle = _sharpened(_with_focal(bundle, pairs, members), pairs, members)
    return SurveyMap(tuple(members), bundle, tuple(pairs)), contradicted


def _with_focal(bundle: Bundle, pairs: Sequence[Pair], members: Sequence[int]) -> Bundle:
    """Return the adjustment with the focal length that the frames give, where it is not known.

    With a looser mount: smaller tilts, and so a shorter focal length, are more probable. Where the
    matches do not agree, the floor has relief, which would give any focal length.
    """
    mount, prior = bundle.mount, bundle.lens.prior
    if prior is None or prior.focal_sigma == 0.0 or mount.tilt_sigma == 0.0:
        return bundle
    limit = _MAX_EXPLAINED_FACTOR * float(np.median([pair.median_pixels for pair in pairs]))
    before = float(np.median(bundle.pair_pixels))
    limit = limit if before <= limit else min(limit, _MAX_FALLEN_SHARE * before)

    def freed(start: Bundle, mount: Mount) -> Bundle:
        states = rescaled(start.states)
        return adjust(pairs, members, states, start.lens, mount, lens_free="all")

    def explained(one: Bundle) -> bool:
        return float(np.median(one.pair_pixels)) <= limit

    found = freed(bundle, replace(mount, tilt_sigma=_LOOSER * mount.tilt_sigma))
    longer = found.lens.focal_pixels / bundle.lens.focal_pixels
    mount = replace(mount, tilt_sigma=longer * mount.tilt_sigma)
    done = adjust(pairs, members, rescaled(found.states), found.lens, mount)
    if explained(found) and explained(done):
        return done
    # How freely the camera moves was learned with a focal length that may be far off.
    first = explained(found)
    for _ in range(_LEARNING_ROUNDS):
        mount = learned_mount(found)
        found = freed(found, mount)
    if explained(found) and float(np.median(found.pair_pixels)) <= _MAX_FALLEN_SHARE * before:
        return adjust(pairs, members, rescaled(found.states), found.lens, mount)
    return done if first else bundle


def _outliers(bundle: Bundle, pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs that the others contradict, the worst half of them at a time."""
    limit = max(
        _OUTLIER_FACTOR * float(np.median(bundle.pair_pixels)),
        _OUTLIER_SHARE * 2.0 * bundle.lens.radius_pixels,
    )
    worst = max(limit, 0.5 * float(bundle.pair_pixels.max()))
    return [pair for pair, error in zip(pairs, bundle.pair_pixels, strict=True) if error > worst]
