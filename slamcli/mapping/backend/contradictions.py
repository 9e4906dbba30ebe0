"""Links that a solved map contradicts, or that alone join its parts: which are to be left out.

After a solution some links are off, as the others contradict them. Where the others are links that
alone hold a part of the map (bridges of its graph), nothing decides which of both is wrong but
their scores; and where these are alike, neither may be used. Before it, a frame's links of a small
score are left out where another one places the frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from slamcli.core.geometry import wrap_angle
from slamcli.core.records import Link
from slamcli.mapping.backend.pose_graph import PoseGraphReader

# Odds of one link over those of another from which on it is clear which of two that contradict one
# another is right [guarded by tests/mapping/backend/test_contradictions.py].
_CLEAR_ODDS_RATIO = 10.0
# Scores nearer to certainty than this are not told apart.
_MIN_WRONG_SHARE = 1e-3
_MIN_TURN_RADIANS = 0.02
# A single link of a smaller score does not join two parts of a map, nor is it used for a frame that
# another one places [guarded by tests/mapping/backend/test_contradictions.py;
# benchmarks/robustness.py, rocking on planks: a second link of 0.59 is 25 mm off].
MIN_JOINING_SCORE = 0.9


def without_unlikely(links: Sequence[Link]) -> Sequence[Link]:
    """Return a frame's links without those of a small score, unless all of them have one."""
    return [link for link in links if link.score >= MIN_JOINING_SCORE] or links


def links_to_leave_out(
    graph: PoseGraphReader, chain: Sequence[Link], min_metres: float
) -> frozenset[int]:
    """Return the indices of links without which a solved graph is to be solved again.

    Parameters
    ----------
    graph : PoseGraphReader
    chain : sequence of Link
        Odometry, which needs no support.
    min_metres : float
        Links that differ from the solution by less, and by less than `_MIN_TURN_RADIANS`, do not
        contradict it.
    """
    links = graph.links
    kept = [n for n in range(len(links)) if n not in graph.switched_off]
    forest = _Forest([*((n, links[n]) for n in kept), *((-1, link) for link in chain)])
    left_out = {
        n
        for n in forest.bridges
        if n >= 0 and links[n].kind == "loop" and links[n].score < MIN_JOINING_SCORE
    }
    for off in sorted(graph.switched_off):
        contradicted = links[off]
        # Steps are trusted before loops: a loop contradicts loops alone.
        bridges = [
            n
            for n in forest.bridges_between(contradicted.a, contradicted.b)
            if n >= 0 and (contradicted.kind != "loop" or links[n].kind == "loop")
        ]
        if bridges and _differs(graph, contradicted, min_metres):
            left_out |= _undecided(links, off, bridges)
    return frozenset(left_out)


def _differs(graph: PoseGraphReader, link: Link, min_metres: float) -> bool:
    """Return whether a link is another motion than that of its frames in the map."""
    if not (graph.is_placed(link.a) and graph.is_placed(link.b)):
        return False
    error = link.a_from_b.inverse() @ graph.pose(link.a).inverse() @ graph.pose(link.b)
    return error.translation_length > min_metres or abs(wrap_angle(error.theta)) > _MIN_TURN_RADIANS


def _undecided(links: Sequence[Link], off: int, bridges: Sequence[int]) -> set[int]:
    """Return which of a link and the bridges that contradict it are not clearly right."""
    odds = {n: _odds(links[n]) for n in (off, *bridges)}
    worst, *others = sorted(odds, key=lambda n: odds[n])
    if odds[others[0]] >= _CLEAR_ODDS_RATIO * odds[worst]:
        return {worst} if worst != off else set()
    limit = _CLEAR_ODDS_RATIO * odds[worst]
    return {n for n in odds if odds[n] < limit}


def _odds(link: Link) -> float:
    score = min(max(link.score, _MIN_WRONG_SHARE), 1.0 - _MIN_WRONG_SHARE)
    return score / (1.0 - score)


class _Forest:
    """A spanning forest of a graph with its bridges (Tarjan, 1974).

    Parameters
    ----------
    edges : sequence of (int, Link)
        Each with its number.
    """

    def __init__(self, edges: Sequence[tuple[int, Link]]) -> None:
        self._neighbours: dict[int, list[tuple[int, int]]] = {}
        self._numbers = [number for number, _ in edges]
        for edge, (_, link) in enumerate(edges):
            self._neighbours.setdefault(link.a, []).append((link.b, edge))
            self._neighbours.setdefault(link.b, []).append((link.a, edge))
        # Of each frame: the order of its visit, its parent and the edge to it.
        self._order: dict[int, int] = {}
        self._parent: dict[int, tuple[int, int]] = {}
        self._bridge_edges: set[int] = set()
        for frame in sorted(self._neighbours):
            if frame not in self._order:
                self._visit(frame)

    @property
    def bridges(self) -> list[int]:
        """Numbers of the edges without which their ends are not connected."""
        return sorted(self._numbers[edge] for edge in self._bridge_edges)

    def bridges_between(self, a: int, b: int) -> Iterator[int]:
        """Yield the numbers of the bridges that every way between two frames takes."""
        if a not in self._order or b not in self._order:
            return
        while a != b:
            # The one that was visited later lies in the other's tree, or in another one.
            later = max(a, b, key=lambda frame: self._order[frame])
            if later not in self._parent:
                return
            parent, edge = self._parent[later]
            if edge in self._bridge_edges:
                yield self._numbers[edge]
            a, b = (parent, b) if later == a else (a, parent)

    def _visit(self, root: int) -> None:
        """Search a component depth-first."""
        lowest: dict[int, int] = {}
        self._order[root] = lowest[root] = len(self._order)
        stack = [(root, iter(self._neighbours[root]))]
        while stack:
            frame, rest = stack[-1]
            came_by = self._parent.get(frame, (-1, -1))[1]
            for other, edge in rest:
                if edge == came_by:
                    continue
                if other in self._order:
                    lowest[frame] = min(lowest[frame], self._order[other])
                    continue
                self._order[other] = lowest[other] = len(self._order)
                self._parent[other] = frame, edge
                stack.append((other, iter(self._neighbours[other])))
                break
            else:
                stack.pop()
                if frame in self._parent:
                    parent, edge = self._parent[frame]
                    lowest[parent] = min(lowest[parent], lowest[frame])
                    if lowest[frame] > self._order[parent]:
                        self._bridge_edges.add(edge)
