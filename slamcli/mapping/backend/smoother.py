"""When to re-optimise the pose graph and over which window (fixed-lag smoothing).

A robot must keep up. The whole graph is optimised while it is small, and when fragments join; else
a window of it, so seldom that a frame costs the same on a large map as on a small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.optimizer import BatchOptimizer
from slamcli.mapping.backend.pose_graph import GraphUpdate, PoseGraph
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.saved_state import SmootherState
from slamcli.stages import posegraph

# Up to this size, or while the offsets of compass and GPS are not known yet, the whole graph is
# optimised whenever it has grown by this share and number of frames.
# [benchmarks/backend.py: 0.7 ms a frame at 1,000 frames, 0.4 ms at 10,000]
_SMALL_FRAMES = 400
_SOLVE_AFTER_GROWTH = 1.25
_SOLVE_AFTER_FRAMES = 20
# Above it, only the frames since the latest solution are, once there are this many: a flat cost.
# [guarded by benchmarks/backend.py]
_WINDOW_FRAMES = 50
# A loop moves all frames between its ends. These are optimised once the frames since the latest
# loop closure are this share of them. [benchmarks/backend.py: last tenth 1.12 times the first]
_LOOP_WINDOW_SHARE = 0.1
# A window of more than this share of the graph is replaced by the whole graph.
# [guarded by benchmarks/backend.py]
_WHOLE_SHARE = 0.8


class FixedLagSmoother:
    """Schedule of the optimisations as frames come (Dellaert and Kaess, Factor Graphs, 2017).

    Reads the graph and returns what is to be applied to it.

    Parameters
    ----------
    sensors : Sensors
    """

    def __init__(self, sensors: Sensors) -> None:
        self._sensors = sensors
        # Number of frames at the latest solution, at the latest one of a whole component, and at
        # the latest loop closure; and the earliest frame to which loops since then reach back.
        self._solved_at = 0
        self._all_solved_at = 0
        self._closed_at = 0
        self._reaches_to: int | None = None

    def state(self) -> SmootherState:
        """Return all that `restore` needs."""
        return SmootherState(
            self._solved_at, self._all_solved_at, self._closed_at, self._reaches_to
        )

    def restore(self, state: SmootherState) -> None:
        """Take over the state of another schedule in place of its own."""
        self._solved_at, self._all_solved_at = state.solved_at, state.all_solved_at
        self._closed_at, self._reaches_to = state.closed_at, state.reaches_to

    def on_frame(self, graph: PoseGraph, index: int, links: Sequence[Link]) -> GraphUpdate | None:
        """Return the result of the optimisation that is due after a frame, or None for none.

        Parameters
        ----------
        graph : PoseGraph
        index : int
            Of the frame.
        links : sequence of Link
            Those that were inserted with it.
        """
        fragment = graph[index].fragment
        if any(graph[link.a].fragment != fragment for link in links):
            return self._optimize_component(graph, index)
        loops = [min(link.a, link.b) for link in links if link.kind == "loop"]
        if loops and self._reaches_to is not None:
            loops.append(self._reaches_to)
        self._reaches_to = min(loops, default=self._reaches_to)
        if self._is_due(graph):
            return self._optimize_component(graph, index)
        if self._sensors.correct_the_map:
            if len(graph.order) - self._solved_at < _WINDOW_FRAMES:
                return None
            return self._optimize_window(graph, index, self._solved_at)
        return self._close_loops(graph, index)

    def on_whole_solution(self, graph: PoseGraph) -> None:
        """Record that the whole graph has been optimised."""
        self._solved_at = self._all_solved_at = self._closed_at = len(graph.order)
        self._reaches_to = None

    def _is_due(self, graph: PoseGraph) -> bool:
        """Return whether the whole is to be optimised, for the frames since the latest time.

        Of a large graph whose sensor offsets are known only windows are, unless loops were closed.
        """
        if not self._sensors.correct_the_map:
            return False
        known = all(map(self._sensors.are_known, graph.offsets.values())) and graph.offsets
        if known and self._reaches_to is None and len(graph.order) > _SMALL_FRAMES:
            return False
        return len(graph.order) > _SOLVE_AFTER_GROWTH * self._all_solved_at + _SOLVE_AFTER_FRAMES

    def _optimize_component(self, graph: PoseGraph, index: int) -> GraphUpdate:
        """Solve the whole component that a frame belongs to."""
        optimizer = BatchOptimizer(graph.estimates, graph.links, self._sensors)
        component = next(one for one in optimizer.components() if index in one)
        self.on_whole_solution(graph)
        return optimizer.solve(component, graph[min(component)].fragment)

    def _close_loops(self, graph: PoseGraph, index: int) -> GraphUpdate | None:
        """Solve all between the ends of the loops, once there are enough frames since the last."""
        if self._reaches_to is None:
            return None
        frames = len(graph.order)
        first = graph.order.index(self._reaches_to)
        reach = frames - first
        if frames - self._closed_at < max(_SOLVE_AFTER_FRAMES, _LOOP_WINDOW_SHARE * reach):
            return None
        if reach > _WHOLE_SHARE * frames:
            return self._optimize_component(graph, index)
        self._reaches_to, self._closed_at = None, frames
        return self._optimize_window(graph, index, first)

    def _optimize_window(self, graph: PoseGraph, index: int, first: int) -> GraphUpdate | None:
        """Solve a frame's fragment from the first-th frame on, all before that fixed.

        Windows with readings of compass and GPS do not overlap: the information of each reading on
        the sensor offsets is counted once.
        """
        fragment = graph[index].fragment
        free = {
            member
            for member in graph.order[first:]
            if graph.is_placed(member) and graph[member].fragment == fragment
        }
        prior = graph.offsets.get(fragment) if self._sensors.correct_the_map else None
        base = graph.placed_before(first, fragment, _SMALL_FRAMES)
        if base is None or (prior is None and self._sensors.correct_the_map):
            return None
        numbers = _links_of(graph, free, fragment, first)
        links = [graph.links[number] for number in numbers]
        fixed = {base} | {end for link in links for end in (link.a, link.b)} - free
        frames = [graph[member] for member in sorted(fixed | free)]
        optimizer = BatchOptimizer(frames, links, self._sensors)
        initial = {frame.index: graph.pose(frame.index) for frame in frames}
        optimized = optimizer.optimize(initial, fixed, prior)
        self._solved_at = len(graph.order)
        return GraphUpdate(
            fragment,
            _window_estimates(graph, sorted(free), base, optimized.solution),
            tuple(numbers),
            frozenset(numbers[place] for place in optimized.switched_off),
            optimized.solution.offsets,
            _added_up(optimized.georeference, graph.georeferences.get(fragment)),
        )


def _links_of(graph: PoseGraph, free: set[int], fragment: int, first: int) -> list[int]:
    """Return the indices of the links of a window's frames within their fragment."""
    return [
        number
        for number in range(graph.links_before[first], len(graph.links))
        if not free.isdisjoint((graph.links[number].a, graph.links[number].b))
        and graph[graph.links[number].a].fragment == fragment
        and graph[graph.links[number].b].fragment == fragment
    ]


def _window_estimates(
    graph: PoseGraph, free: Sequence[int], base: int, solution: posegraph.Solution
) -> tuple[PoseEstimate, ...]:
    """Return a window's estimates; their covariances add that of a fixed frame before it."""
    known = graph[base].covariance
    assert known is not None
    estimates = []
    for member in free:
        pose = solution.poses[member]
        covariance = posegraph.compose_covariance(
            known, graph.pose(base).inverse() @ pose, solution.covariances[member]
        )
        estimates.append(replace(graph[member], map_from_robot=pose, covariance=covariance))
    return tuple(estimates)


def _added_up(found: Georeference | None, before: Georeference | None) -> Georeference | None:
    """Return a window's georeference with the earlier windows' readings counted too."""
    if found is None or before is None:
        return found
    # A window takes older poses for certain; the covariance of the whole has their errors too.
    return replace(
        found,
        covariance=before.covariance,
        readings=found.readings + before.readings,
        outliers=found.outliers + before.outliers,
    )
