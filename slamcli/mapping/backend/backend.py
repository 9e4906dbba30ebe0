"""What is known so far: every frame's estimate, every link between two, and the weighing of them.

The loop (`slamcli.mapping.mapper`) decides which links are believed; here they place frames,
connect fragments and are solved. No file, thread, clock or print.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate, PreparedFrame
from slamcli.core.telemetry import Georeference
from slamcli.mapping.backend.pose_graph import PoseGraph
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.backend.smoother import FixedLagSmoother
from slamcli.stages import posegraph

SAME_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])


class Backend(PoseGraph):
    """Places frames by the links that tie them, and weighs all that is known of them."""

    def __init__(self, sensors: Sensors | None = None) -> None:
        super().__init__()
        self.sensors = sensors or Sensors()
        self._smoother = FixedLagSmoother(self, self.sensors)
        self._next_fragment = 0

    @property
    def switched_off(self) -> frozenset[int]:
        """Places in `links` of those that the others contradict, as of the latest solution."""
        return self._smoother.switched_off

    @property
    def georeferences(self) -> dict[int, Georeference]:
        """Where on Earth each fragment that GPS tells of lies, as of the latest solution."""
        return self._smoother.georeferences

    def begin_fragment(self, prepared: PreparedFrame) -> PoseEstimate:
        """Make a frame the origin of a map of its own, unless odometry has carried it here."""
        known = self.get(prepared.index)
        if known is not None and known.map_from_robot is not None:
            return known
        fragment = self._next_fragment
        self._next_fragment += 1
        odom = self._odom_after(prepared, None)
        begun = _estimate(prepared, Pose2(), fragment, SAME_POSE_COVARIANCE)
        return self.set_estimate(replace(begun, odom_from_robot=odom))

    def adopt(self, estimate: PoseEstimate) -> None:
        """Take over what an earlier run knew of a frame."""
        self.set_estimate(estimate)
        self._next_fragment = max(self._next_fragment, estimate.fragment + 1)

    def place(self, prepared: PreparedFrame, links: Sequence[Link]) -> PoseEstimate:
        """Place a frame by the surest of its links; those to another fragment join the two."""
        odom = self._odom_after(prepared, min(links, key=_uncertainty))
        self.set_estimate(replace(self.predict_pose(prepared, links), odom_from_robot=odom))
        self.add_links(prepared.index, links)
        return self[prepared.index]

    def predict_pose(self, prepared: PreparedFrame, links: Sequence[Link]) -> PoseEstimate:
        """Return where the surest of its links to known frames puts a frame, which is not kept."""
        link = min(links, key=_uncertainty)
        origin = self[link.a]
        assert origin.covariance is not None
        pose = self.pose(link.a) @ link.a_from_b
        covariance = posegraph.compose_covariance(origin.covariance, link.a_from_b, link.covariance)
        placed = _estimate(prepared, pose, origin.fragment, covariance)
        return replace(placed, inliers=link.inliers, score=link.score)

    def add_links(self, index: int, links: Sequence[Link]) -> None:
        """Add links of a placed frame; those to another fragment join the two."""
        self.links += links
        if moved := self._smoother.on_frame(index, links):
            self.revise(index, moved)

    def odometry_between(
        self, index: int, prepared: PreparedFrame
    ) -> tuple[Pose2, Float64Array] | None:
        """Return how far odometry says a frame is from an earlier one, and how surely."""
        now = lost(prepared, "")
        link = self.sensors.link(self[index], now)
        return None if link is None else (link.a_from_b, link.covariance)

    def add_duplicate(self, before: PreparedFrame, prepared: PreparedFrame) -> PoseEstimate:
        """Give a frame that shows the same picture as the one before it the same estimate.

        Unless that one could not be placed by what it shows: a robot may move over bare floor.
        """
        known = self[before.index]
        if known.status != "tracked":
            return self.add_lost(prepared, known.reason or f"same picture as {before.name}")
        kept = self.set_estimate(
            replace(
                known,
                index=prepared.index,
                name=prepared.name,
                stamp=prepared.stamp,
                reason=known.reason or f"same picture as {before.name}",
                revised=(),
            )
        )
        same = Link(before.index, prepared.index, Pose2(), SAME_POSE_COVARIANCE, 0, 1.0, "step")
        self.links.append(same)
        return kept

    def add_lost(
        self, prepared: PreparedFrame, reason: str, partial: Link | None = None
    ) -> PoseEstimate:
        """Keep a frame that its picture does not place: predicted by odometry, or lost.

        Parameters
        ----------
        prepared : PreparedFrame
        reason : str
        partial : Link or None
            To a placed frame: what the picture tells of some directions. Odometry fills the others.
        """
        lacking = lost(prepared, reason)
        latest = self.latest_placed if partial is None else self[partial.a]
        link = None if latest is None else self.sensors.link(latest, lacking)
        if latest is None or link is None:
            return self.set_estimate(lacking)
        if partial is not None:
            self.links.append(partial)
            link = posegraph.fuse(link, partial)
        assert latest.covariance is not None
        pose = self.pose(latest.index) @ link.a_from_b
        covariance = posegraph.compose_covariance(latest.covariance, link.a_from_b, link.covariance)
        predicted = _estimate(prepared, pose, latest.fragment, covariance)
        odom = self._odom_after(prepared, None)
        return self.set_estimate(
            replace(predicted, status="predicted", reason=reason, odom_from_robot=odom)
        )

    def revise(self, index: int, others: tuple[int, ...]) -> PoseEstimate:
        """Note that a frame's coming changed the estimates of others."""
        known = self[index]
        return self.set_estimate(replace(known, revised=(*known.revised, *others)))

    def solve(self) -> None:
        """Weigh all that is known, and number the fragments anew, the largest first.

        Fragments that links, odometry or GPS connect become one; each has its first frame as its
        origin. A frame that nothing ties to any other is lost; one that only odometry ties to the
        others is predicted.
        """
        optimizer = self._smoother.optimizer()
        components = optimizer.components()
        linked = [component for component in components if len(component) > 1] or components[:1]
        for component in components:
            if component not in linked:
                self.set_estimate(lost(self[min(component)], "overlaps no other frame"))
        linked = optimizer.merge_by_gps(linked)
        linked.sort(key=lambda component: (-len(component), min(component)))
        self._smoother.reset()
        for fragment, initial in enumerate(linked):
            self._smoother.solve(initial, fragment)

    def _odom_after(self, prepared: PreparedFrame, link: Link | None) -> Pose2:
        """Return ``odom_from_robot`` of a new frame: by its step, else odometry, else unmoved."""
        latest = self.latest_placed
        if latest is None or latest.odom_from_robot is None:
            return Pose2()
        if link is not None and link.kind == "step":
            origin = self[link.a]
            if origin.odom_from_robot is not None and origin.fragment == latest.fragment:
                return origin.odom_from_robot @ link.a_from_b
        felt = self.odometry_between(latest.index, prepared)
        return latest.odom_from_robot if felt is None else latest.odom_from_robot @ felt[0]


def lost(frame: PreparedFrame | PoseEstimate, reason: str) -> PoseEstimate:
    """Return the estimate of a frame that could not be placed."""
    return PoseEstimate(frame.index, frame.name, frame.stamp, None, "lost", reason)


def _estimate(
    prepared: PreparedFrame, pose: Pose2, fragment: int, covariance: Float64Array
) -> PoseEstimate:
    return PoseEstimate(
        prepared.index, prepared.name, prepared.stamp, pose, "tracked", "", fragment, covariance
    )


def _uncertainty(link: Link) -> float:
    return float(np.linalg.det(link.covariance))
