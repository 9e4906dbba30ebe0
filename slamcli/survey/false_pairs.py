"""False pairs of a map: those that bring frames to overlap whose pixels show unrelated floor.

Copied texture, as on a floor of boards with few prints, gives false pairs that agree with one
another, so that their residuals are small. But they lay strips of frames over one another, and
there the pixels differ.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from slamcli.core.geometry import invert
from slamcli.survey.bundle import Bundle
from slamcli.survey.candidates import NumberPair, by_overlap
from slamcli.survey.features import SurveyFeatures
from slamcli.survey.overlap_pixels import MAX_UNRELATED_SHARE, unrelated_share
from slamcli.survey.pairs import Pair


def overlaps(
    bundle: Bundle, frames: Sequence[int], features: Sequence[SurveyFeatures]
) -> list[NumberPair]:
    """Return the pairs of frames of one map that its poses predict to overlap."""
    homographies = bundle.lens.project(bundle.states).image_from_map
    return by_overlap(homographies, frames, [features[frame].size for frame in frames])


def contradicted_overlaps(
    bundle: Bundle,
    frames: Sequence[int],
    pairs: Sequence[Pair],
    features: Sequence[SurveyFeatures],
) -> list[NumberPair]:
    """Return the pairs of frames that overlap in a map, but show unrelated floor there.

    Verified pairs were compared before.
    """
    homographies = bundle.lens.project(bundle.states).image_from_map
    image_from_map = dict(zip(frames, homographies, strict=True))

    def unrelated(a: int, b: int) -> float:
        a_from_b = image_from_map[a] @ invert(image_from_map[b])
        return unrelated_share(features[a], features[b], a_from_b)

    known = {(pair.a, pair.b) for pair in pairs}
    predicted = [pair for pair in overlaps(bundle, frames, features) if pair not in known]
    return [pair for pair in predicted if unrelated(*pair) > MAX_UNRELATED_SHARE]


def least_consistent(pairs: Sequence[Pair], contradicted: Sequence[NumberPair]) -> Pair:
    """Return the pair on most of the shortest paths between frames of contradicted overlaps.

    Of those with as many, the one with most unrelated floor, then the weakest.
    """
    neighbours: dict[int, list[tuple[int, Pair]]] = {}
    for pair in pairs:
        neighbours.setdefault(pair.a, []).append((pair.b, pair))
        neighbours.setdefault(pair.b, []).append((pair.a, pair))
    counted = Counter[Pair]()
    for a, b in contradicted:
        counted.update(_path(neighbours, a, b))

    def order(pair: Pair) -> tuple[float, ...]:
        return counted[pair], pair.unrelated_share, -pair.strength, -pair.a, -pair.b

    return max(counted, key=order)


def _path(neighbours: dict[int, list[tuple[int, Pair]]], start: int, goal: int) -> list[Pair]:
    """Return the fewest pairs that connect two frames of one map."""
    came: dict[int, tuple[int, Pair]] = {}
    frontier = [start]
    while goal not in came:
        following = []
        for frame in frontier:
            for other, pair in neighbours[frame]:
                if other not in came and other != start:
                    came[other] = frame, pair
                    following.append(other)
        frontier = following
    path = []
    while goal != start:
        goal, pair = came[goal]
        path.append(pair)
    return path
