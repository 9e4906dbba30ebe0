"""The back end: inserts frames and links into the pose graph and keeps it optimised."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamcli.core.geometry import Pose2, wrap_angle
from slamcli.core.records import Link, PoseEstimate, PreparedFrame
from slamcli.mapping.backend.contradictions import links_to_leave_out, without_unlikely
from slamcli.mapping.backend.optimizer import CONTRADICTED, BatchOptimizer, InitialPoses
from slamcli.mapping.backend.pose_graph import PoseGraph, lost, most_certain, tracked
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.backend.smoother import FixedLagSmoother
from slamcli.mapping.saved_state import GraphState, SmootherState
from slamcli.stages import posegraph

# Of poses that are equal by definition (m, rad): the equations need a covariance above 0.
_SAME_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])
# A later fragment of a smaller extent than this share of the camera's range, and of less turn, did
# not move: what its frames show moved with the camera, as a hand before the lens does
# [benchmarks/kidnap.py: hand].
_MIN_EXTENT_SHARE = 0.03
_MIN_TURN_RADIANS = 0.1
# Links that two pictures determine in all directions.
_BY_PICTURE = ("step", "loop")
# Links that differ from the map by less, as a share of the camera's range, do not contradict it so
# that parts of it are left out [guarded by benchmarks/robustness.py: rocking].
_MIN_CONTRADICTION_SHARE = 0.01


class Backend:
    """The pose graph with its sensors and optimisers.

    Parameters
    ----------
    sensors : Sensors or None
        Readings of odometry, compass and GPS; None for none.
    range_metres : float
        How far the camera sees.

    Attributes
    ----------
    graph : PoseGraph
        To be read; only the back end changes it.
    sensors : Sensors
    """

    def __init__(self, sensors: Sensors | None = None, range_metres: float = 0.0) -> None:
        self._range_metres = range_metres
        self.graph = PoseGraph()
        self.sensors = sensors or Sensors()
        self._smoother = FixedLagSmoother(self.sensors)
        self._next_fragment = 0

    def state(self) -> tuple[GraphState, int, SmootherState]:
        """Return the graph, the number of the next fragment, and the optimisers' schedule."""
        return self.graph.state(), self._next_fragment, self._smoother.state()

    def restore(self, graph: GraphState, next_fragment: int, smoother: SmootherState) -> None:
        """Take over the state of another back end, but for its sensors."""
        self.graph.restore(graph)
        self._compare_odometry(self.graph.links)
        self._next_fragment = next_fragment
        self._smoother.restore(smoother)

    def begin_fragment(self, prepared: PreparedFrame) -> PoseEstimate:
        """Make a frame the origin of a new fragment, unless odometry has placed it already."""
        known = self.graph.get(prepared.index)
        if known is not None and known.map_from_robot is not None:
            return known
        fragment = self._next_fragment
        self._next_fragment += 1
        odom = self._odom_after(prepared, None)
        origin = tracked(prepared, Pose2(), _SAME_POSE_COVARIANCE, fragment)
        return self.graph.set_estimate(replace(origin, odom_from_robot=odom))

    def add_map(self, estimates: Sequence[PoseEstimate], links: Sequence[Link]) -> None:
        """Insert the frames and links of a finished map."""
        for estimate in estimates:
            self.graph.set_estimate(estimate)
            self._next_fragment = max(self._next_fragment, estimate.fragment + 1)
        self.graph.add_links(links)

    def place(
        self, prepared: PreparedFrame, links: Sequence[Link], *, revisited: bool = False
    ) -> PoseEstimate:
        """Insert a frame by the most certain of its links; links to another fragment join both.

        Links that are likely to be wrong are left out where another one places the frame.

        Parameters
        ----------
        prepared : PreparedFrame
        links : sequence of Link
        revisited : bool
            Whether they come from floor that was seen long ago: odometry is then compared with the
            step from the latest frame.
        """
        links = without_unlikely(links)
        predicted = self.graph.predict_pose(prepared, links)
        moved = links
        if revisited and (step := self._step_from_latest(predicted)) is not None:
            moved = [step]
        odom = self._odom_after(prepared, most_certain(moved))
        self.graph.set_estimate(replace(predicted, odom_from_robot=odom))
        self.add_links(prepared.index, links)
        self._compare_odometry(moved)
        return self.graph[prepared.index]

    def _step_from_latest(self, placed: PoseEstimate) -> Link | None:
        """Return a frame's motion from the latest placed one by the map; None from another one."""
        latest = self.graph.latest_placed
        assert placed.map_from_robot is not None
        assert placed.covariance is not None
        if latest is None or latest.map_from_robot is None or latest.fragment != placed.fragment:
            return None
        motion = latest.map_from_robot.inverse() @ placed.map_from_robot
        return Link(latest.index, placed.index, motion, placed.covariance, 0, math.nan, "step")

    def place_between(self, prepared: PreparedFrame, link: Link) -> PoseEstimate:
        """Insert a lost frame among placed ones by a link; `solve` then optimises all of them."""
        odom = self.graph[link.a].odom_from_robot
        self.graph.add_links([link])
        return self.graph.set_estimate(
            replace(
                self.graph.predict_pose(prepared, [link]),
                odom_from_robot=None if odom is None else odom @ link.a_from_b,
            )
        )

    def _compare_odometry(self, links: Sequence[Link]) -> None:
        """Compare odometry with what pictures showed, but for those that only repeat another."""
        for link in links:
            if link.kind in _BY_PICTURE and link.a_from_b != Pose2():
                self.sensors.compare(self.graph[link.a], self.graph[link.b], link.a_from_b)

    def add_links(self, index: int, links: Sequence[Link]) -> None:
        """Add links of a frame that is placed; links to another fragment join both."""
        self.graph.add_links(links)
        update = self._smoother.on_frame(self.graph, index, links)
        if update is not None:
            self.graph.apply(update)
            self.add_revised(index, [e.index for e in update.estimates if e.index != index])

    def add_duplicate(self, before: PreparedFrame, prepared: PreparedFrame) -> PoseEstimate:
        """Insert a frame whose picture equals that of the one before, with the same estimate.

        Not so where the picture did not place that one: a robot may move over bare floor.
        """
        known = self.graph[before.index]
        reason = known.reason or f"same picture as {before.name}"
        if known.status != "tracked":
            return self.add_lost(prepared, reason)
        estimate = self.graph.set_estimate(
            replace(
                known,
                index=prepared.index,
                name=prepared.name,
                stamp=prepared.stamp,
                reason=reason,
                revised=(),
            )
        )
        same = Link(before.index, prepared.index, Pose2(), _SAME_POSE_COVARIANCE, 0, 1.0, "step")
        self.graph.add_links([same])
        return estimate

    def add_lost(
        self, prepared: PreparedFrame, reason: str, partial: Link | None = None
    ) -> PoseEstimate:
        """Insert a frame that its picture does not place: predicted by odometry, or lost.

        Parameters
        ----------
        prepared : PreparedFrame
        reason : str
        partial : Link or None
            To a placed frame: the directions that the picture does determine. Odometry determines
            the others.
        """
        latest = self.graph.latest_placed if partial is None else self.graph[partial.a]
        link = None if latest is None else self.sensors.link(latest, prepared)
        if latest is None or link is None:
            return self.graph.set_estimate(lost(prepared, reason))
        if partial is not None:
            link = posegraph.fuse(link, partial)
        predicted = tracked(prepared, *self.graph.compose(link), latest.fragment)
        odom = self._odom_after(prepared, None)
        estimate = self.graph.set_estimate(
            replace(predicted, status="predicted", reason=reason, odom_from_robot=odom)
        )
        if partial is not None:
            self.graph.add_links([partial])
        return estimate

    def add_revised(self, index: int, others: Sequence[int]) -> PoseEstimate:
        """Record in a frame's estimate that its insertion changed those of others."""
        known = self.graph[index]
        return self.graph.set_estimate(replace(known, revised=(*known.revised, *others)))

    def solve(self, loops: Sequence[Link] = ()) -> None:
        """Optimise the whole graph, and number the fragments anew, the largest first.

        Fragments that links, odometry or GPS connect become one; each has its first frame as its
        origin. A frame without a link to any other is lost; one that only odometry connects to the
        others is predicted.

        Parameters
        ----------
        loops : sequence of Link
            Added first.
        """
        self.graph.add_links(loops)
        left_out: frozenset[int] = frozenset()
        while True:
            self._solve_without(left_out)
            more = self._contradicted() - left_out
            if not more:
                break
            left_out |= more
        self.graph.switched_off |= left_out

    def _solve_without(self, left_out: frozenset[int]) -> None:
        """Optimise all components of the graph without some of its links, given by index."""
        graph = self.graph
        optimizer = BatchOptimizer(graph.estimates, graph.links, self.sensors, left_out)
        components = optimizer.components()
        connected = [component for component in components if len(component) > 1] or components[:1]
        ends = {end for n in left_out for end in (graph.links[n].a, graph.links[n].b)}
        for component in components:
            if component not in connected:
                alone = "overlaps no other frame" if ends.isdisjoint(component) else CONTRADICTED
                self._lose(component, alone)
        connected = optimizer.merge_by_gps(connected)
        for component in [one for one in connected[1:] if not self._moves(one)]:
            self._lose(component, "what it shows stays where it is: it moves with the camera")
            connected.remove(component)
        connected.sort(key=lambda component: (-len(component), min(component)))
        self.sensors.gps_fault = ""
        graph.clear_solution()
        for fragment, initial in enumerate(connected):
            graph.apply(optimizer.solve(initial, fragment))
        if connected:
            self._smoother.on_whole_solution(graph)

    def _contradicted(self) -> frozenset[int]:
        """Return the links without which the solved graph is to be solved again."""
        graph = self.graph
        placed = [e for e in graph.estimates if e.map_from_robot is not None]
        return links_to_leave_out(
            graph, self.sensors.chain(placed), _MIN_CONTRADICTION_SHARE * self._range_metres
        )

    def _moves(self, component: InitialPoses) -> bool:
        """Return whether the frames of a component lie farther apart than a standing camera's."""
        poses = list(component.values())
        places = np.array([(pose.x, pose.y) for pose in poses])
        turns = [abs(wrap_angle(pose.theta - poses[0].theta)) for pose in poses]
        extent_metres = float(np.ptp(places, axis=0).max())
        least_metres = _MIN_EXTENT_SHARE * self._range_metres
        return extent_metres >= least_metres or max(turns) >= _MIN_TURN_RADIANS

    def _lose(self, component: InitialPoses, reason: str) -> None:
        for index in component:
            self.graph.set_estimate(lost(self.graph[index], reason))

    def _odom_after(self, prepared: PreparedFrame, link: Link | None) -> Pose2:
        """Return ``odom_from_robot`` of a new frame: by its step, else odometry, else unmoved."""
        latest = self.graph.latest_placed
        if latest is None or latest.odom_from_robot is None:
            return Pose2()
        if link is not None and link.kind == "step":
            origin = self.graph[link.a]
            if origin.odom_from_robot is not None and origin.fragment == latest.fragment:
                return origin.odom_from_robot @ link.a_from_b
        measured = self.sensors.link(latest, prepared)
        odom = latest.odom_from_robot
        return odom if measured is None else odom @ measured.a_from_b
