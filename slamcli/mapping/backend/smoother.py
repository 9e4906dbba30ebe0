"""When what is known is weighed anew, how much of it, and what becomes of the poses.

A robot must keep up: the whole map is solved as it is small, as parts of it join and at last; in
between, a window of it, so seldom that a frame costs the same on a large map as on a small one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.optimizer import BatchOptimizer, OptimizedComponent
from slamcli.mapping.backend.pose_graph import PoseGraph
from slamcli.mapping.backend.sensors import Sensors
from slamcli.stages import posegraph

# While a map is smaller than this, or what compass and GPS are off by is not known yet, it is
# solved anew as it grows by this share and so many frames.
_SMALL_FRAMES = 400
_SOLVE_AFTER_GROWTH = 1.25
_SOLVE_AFTER_FRAMES = 20
# From then on only the frames that came since are, whenever so many have: that cost stays flat.
_WINDOW_FRAMES = 50
# A loop moves all frames between its ends, which are solved anew when so many have come as are
# this share of them; when they are nearly the whole map, that is.
_LOOP_WINDOW_SHARE = 0.1
_WHOLE_SHARE = 0.8
# Links that do not place a frame by what it shows: odometry has a share in both.
_CARRIED = ("odometry", "partial")


class FixedLagSmoother:
    """Solves a drive's frames, all or a window of them.

    Parameters
    ----------
    track : PoseGraph
        Its estimates are revised.
    senses : Sensors
    """

    def __init__(self, track: PoseGraph, sensors: Sensors) -> None:
        self.switched_off: frozenset[int] = frozenset()
        self.georeferences: dict[int, Georeference] = {}
        self._track = track
        self._sensors = sensors
        self._offsets: dict[int, posegraph.SensorOffsets] = {}
        # How many frames there were at the latest solution, at the latest of the whole map, and at
        # the latest that closed loops; and the frame that loops since then reach back to.
        self._solved_at = 0
        self._all_solved_at = 0
        self._closed_at = 0
        self._reaches_to: int | None = None

    def optimizer(self) -> BatchOptimizer:
        """Return all that is known, as it is now."""
        return BatchOptimizer(self._track.estimates, self._track.links, self._sensors)

    def on_frame(self, index: int, links: Sequence[Link]) -> tuple[int, ...]:
        """Solve what is due now that a frame has come; return the other frames that it moved.

        Parameters
        ----------
        index : int
        links : sequence of Link
            Those that came with it.
        """
        track = self._track
        fragment = track[index].fragment
        if any(track[link.a].fragment != fragment for link in links):
            return self._optimize_component(index)
        loops = [min(link.a, link.b) for link in links if link.kind == "loop"]
        if loops and self._reaches_to is not None:
            loops.append(self._reaches_to)
        self._reaches_to = min(loops, default=self._reaches_to)
        if self._is_due():
            return self._optimize_component(index)
        if self._sensors.correct_the_map:
            waiting = len(track.order) - self._solved_at
            return (
                self._optimize_window(index, self._solved_at) if waiting >= _WINDOW_FRAMES else ()
            )
        return self._close_loops(index)

    def solve(self, initial: dict[int, Pose2], fragment: int) -> None:
        """Solve one component, its first frame at the origin, and revise its estimates."""
        track = self._track
        optimized = self.optimizer().optimize(initial)
        solution = optimized.solution
        self._solved_at = self._all_solved_at = self._closed_at = len(track.order)
        self._reaches_to = None
        self._offsets[fragment] = solution.offsets
        self.switched_off = self.switched_off.difference(optimized.numbers) | optimized.switched_off
        used = set(optimized.numbers) - optimized.switched_off
        shown = [track.links[n] for n in used if track.links[n].kind not in _CARRIED]
        seen = {end for link in shown for end in (link.a, link.b)}
        for index in initial:
            known = track[index]
            tracked = known.status == "tracked" or index in seen
            track.set_estimate(
                replace(
                    known,
                    map_from_robot=solution.poses[index],
                    covariance=solution.covariances[index],
                    fragment=fragment,
                    status="tracked" if tracked else "predicted",
                    reason="" if tracked and known.status != "tracked" else known.reason,
                )
            )
        self._locate_on_earth(fragment, optimized)

    def reset(self) -> None:
        """Forget the latest solution, as all is about to be solved anew."""
        self.switched_off = frozenset()
        self.georeferences = {}
        self._offsets = {}

    def _is_due(self) -> bool:
        """Return whether so many frames have come since the whole was solved that it is worth it.

        Of a large map whose senses are settled, only the latest frames are, and the whole when
        loops were found, and at last.
        """
        if not self._sensors.correct_the_map:
            return False
        settled = all(map(self._sensors.are_settled, self._offsets.values())) and self._offsets
        if settled and self._reaches_to is None and len(self._track.order) > _SMALL_FRAMES:
            return False
        grown = _SOLVE_AFTER_GROWTH * self._all_solved_at + _SOLVE_AFTER_FRAMES
        return len(self._track.order) > grown

    def _optimize_component(self, index: int) -> tuple[int, ...]:
        """Re-solve the component that a frame belongs to."""
        component = next(
            component for component in self.optimizer().components() if index in component
        )
        self.solve(component, self._track[min(component)].fragment)
        return tuple(member for member in sorted(component) if member != index)

    def _close_loops(self, index: int) -> tuple[int, ...]:
        """Solve what loops tie to the latest frames, once enough of these have come."""
        if self._reaches_to is None:
            return ()
        frames = len(self._track.order)
        first = self._track.order.index(self._reaches_to)
        reach = frames - first
        if frames - self._closed_at < max(_SOLVE_AFTER_FRAMES, _LOOP_WINDOW_SHARE * reach):
            return ()
        if reach > _WHOLE_SHARE * frames:
            return self._optimize_component(index)
        self._reaches_to, self._closed_at = None, frames
        return self._optimize_window(index, first)

    def _optimize_window(self, index: int, first: int) -> tuple[int, ...]:
        """Solve a frame's fragment from the frame with a number on, all before that held.

        A fixed-lag smoother (Dellaert and Kaess, Factor Graphs for Robot Perception, 2017). Windows
        with readings of compass and GPS do not overlap: what they tell of the senses' offsets adds
        up.
        """
        track = self._track
        fragment = track[index].fragment
        members = [
            member
            for member in track.order[first:]
            if track.is_placed(member) and track[member].fragment == fragment
        ]
        prior = self._offsets.get(fragment) if self._sensors.correct_the_map else None
        base = track.placed_before(first, fragment, _SMALL_FRAMES)
        if base is None or (prior is None and self._sensors.correct_the_map):
            return ()
        free = set(members)
        numbers = [
            number
            for number in range(track.links_before[first], len(track.links))
            if not free.isdisjoint((track.links[number].a, track.links[number].b))
            and track[track.links[number].a].fragment == fragment
            and track[track.links[number].b].fragment == fragment
        ]
        links = [track.links[number] for number in numbers]
        held = {base} | {end for link in links for end in (link.a, link.b)} - free
        frames = [track[member] for member in sorted(held | free)]
        optimizer = BatchOptimizer(frames, links, self._sensors)
        optimized = optimizer.optimize({f.index: track.pose(f.index) for f in frames}, held, prior)
        off = frozenset(numbers[place] for place in optimized.switched_off)
        self.switched_off = self.switched_off.difference(numbers) | off
        self._revise_window(members, base, optimized.solution)
        self._offsets[fragment] = optimized.solution.offsets
        self._locate_on_earth(fragment, optimized, self.georeferences.get(fragment))
        self._solved_at = len(track.order)
        return tuple(member for member in sorted(free) if member != index)

    def _revise_window(self, members: list[int], base: int, solution: posegraph.Solution) -> None:
        """Take over poses that were solved with others held, of which one is surely known."""
        track = self._track
        known = track[base].covariance
        assert known is not None
        for member in members:
            pose = solution.poses[member]
            covariance = posegraph.compose_covariance(
                known, track.pose(base).inverse() @ pose, solution.covariances[member]
            )
            track.set_estimate(replace(track[member], map_from_robot=pose, covariance=covariance))

    def _locate_on_earth(
        self, fragment: int, optimized: OptimizedComponent, before: Georeference | None = None
    ) -> None:
        found = optimized.georeference
        if found is not None and before is not None:
            readings = found.readings + before.readings
            outliers = found.outliers + before.outliers
            # A window takes older poses for certain; the sigmas of the whole hold their errors too.
            found = replace(
                found, covariance=before.covariance, readings=readings, outliers=outliers
            )
        if found is not None:
            self.georeferences[fragment] = found
