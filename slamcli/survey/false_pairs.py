"""False pairs of a map: those that bring frames to overlap whose pixels show unrelated floor.

Copied texture, as on a floor of boards with few prints, gives false pairs that agree with one
another, so that their residuals are small. But they lay strips of frames over one another, and
there the pixels differ; or true pairs contradict them. Either way pairs that are not all true close
a cycle, and of a cycle the pair is false whose own pixels agree least: a copy is never exact.
"""

from __future__ import annotations

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


def least_correlated(
    pairs: Sequence[Pair], overlapping: Sequence[NumberPair], outliers: Sequence[Pair]
) -> Pair | None:
    """Return, of the pairs of a map, the least correlated one of its contradictory cycles.

    None where there are none, or where in each the outlier itself agrees least.

    Parameters
    ----------
    pairs : sequence of Pair
        The map's own.
    overlapping : sequence of (int, int)
        Frames whose overlap shows unrelated floor: they, and the pairs between them.
    outliers : sequence of Pair
        Verified pairs that the map contradicts: they, and the pairs between their frames.
    """
    neighbours: dict[int, list[tuple[int, Pair]]] = {}
    for pair in pairs:
        neighbours.setdefault(pair.a, []).append((pair.b, pair))
        neighbours.setdefault(pair.b, []).append((pair.a, pair))

    def order(pair: Pair) -> tuple[float, int, int]:
        return pair.correlation, pair.a, pair.b

    found = [min(_path(neighbours, a, b), key=order) for a, b in overlapping]
    for pair in outliers:
        if pair.a in neighbours and pair.b in neighbours:
            least = min(_path(neighbours, pair.a, pair.b), key=order)
            if least.correlation < pair.correlation:
                found.append(least)
    return min(found, key=order, default=None)


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
