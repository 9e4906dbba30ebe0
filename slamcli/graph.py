"""What is known so far: every frame's estimate, every link between two, and the weighing of them.

The loop (`slamcli.mapper`) decides which links are believed; here they place frames, connect
fragments and are solved. No file, thread, clock or print.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.fusion import Senses
from slamcli.stages import posegraph
from slamcli.weighing import Weighing

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from slamcli.core.records import Prepared
    from slamcli.core.telemetry import Georeference

SAME_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])
# As a map grows by this share and so many frames, compass and GPS correct it again.
_SOLVE_AFTER_GROWTH = 1.25
_SOLVE_AFTER_FRAMES = 20


class Graph:
    """Frames by index, each with its estimate, and the links that tie them."""

    def __init__(self, senses: Senses | None = None) -> None:
        self.links: list[Link] = []
        self.senses = senses or Senses()
        self.switched_off: frozenset[int] = frozenset()
        self.georeferences: dict[int, Georeference] = {}
        self._estimates: dict[int, PoseEstimate] = {}
        self._next_fragment = 0
        self._odom = Pose2()
        self._solved_at = 0

    def __contains__(self, index: int) -> bool:
        return index in self._estimates

    def __getitem__(self, index: int) -> PoseEstimate:
        return self._estimates[index]

    def get(self, index: int) -> PoseEstimate | None:
        """Return a frame's estimate, or None when there was no such frame."""
        return self._estimates.get(index)

    @property
    def estimates(self) -> list[PoseEstimate]:
        """One for every frame so far, in order."""
        return [self._estimates[index] for index in sorted(self._estimates)]

    @property
    def next_index(self) -> int:
        """One more than any frame's."""
        return max(self._estimates, default=-1) + 1

    def pose(self, index: int) -> Pose2:
        """Return ``map_from_robot`` of a frame that is placed."""
        pose = self._estimates[index].map_from_robot
        assert pose is not None
        return pose

    def is_placed(self, index: int) -> bool:
        """Return whether a frame has a pose."""
        return self._estimates[index].map_from_robot is not None

    def is_tracked(self, index: int) -> bool:
        """Return whether a frame was placed by what it shows."""
        return self._estimates[index].status == "tracked"

    def begin_fragment(self, prepared: Prepared) -> PoseEstimate:
        """Make a frame the origin of a map of its own, unless odometry has carried it here."""
        known = self._estimates.get(prepared.index)
        if known is not None and known.map_from_robot is not None:
            return known
        fragment = self._next_fragment
        self._next_fragment += 1
        odom = self._odom_after(prepared, None)
        begun = _estimate(prepared, Pose2(), fragment, SAME_POSE_COVARIANCE)
        return self._keep(replace(begun, odom_from_robot=odom))

    def adopt(self, estimate: PoseEstimate) -> None:
        """Take over what an earlier run knew of a frame."""
        self._keep(estimate)
        self._next_fragment = max(self._next_fragment, estimate.fragment + 1)

    def place(self, prepared: Prepared, links: Sequence[Link]) -> PoseEstimate:
        """Place a frame by the surest of its links; those to another fragment join the two."""
        odom = self._odom_after(prepared, min(links, key=_uncertainty))
        self._keep(replace(self.where(prepared, links), odom_from_robot=odom))
        self.tie(prepared.index, links)
        return self._estimates[prepared.index]

    def where(self, prepared: Prepared, links: Sequence[Link]) -> PoseEstimate:
        """Return where the surest of its links to known frames puts a frame, which is not kept."""
        link = min(links, key=_uncertainty)
        origin = self._estimates[link.a]
        assert origin.covariance is not None
        pose = self.pose(link.a) @ link.a_from_b
        covariance = posegraph.compose_covariance(origin.covariance, link.a_from_b, link.covariance)
        placed = _estimate(prepared, pose, origin.fragment, covariance)
        return replace(placed, inliers=link.inliers, score=link.score)

    def tie(self, index: int, links: Sequence[Link]) -> None:
        """Add links of a placed frame; those to another fragment join the two."""
        self.links += links
        fragment = self._estimates[index].fragment
        joins = any(self._estimates[link.a].fragment != fragment for link in links)
        if joins or self._is_due():
            self._join(index)

    def carried(self, index: int, prepared: Prepared) -> tuple[Pose2, NDArray[np.float64]] | None:
        """Return how far odometry says a frame is from an earlier one, and how surely."""
        now = lost(prepared, "")
        link = self.senses.link(self._estimates[index], now)
        return None if link is None else (link.a_from_b, link.covariance)

    def repeat(self, before: Prepared, prepared: Prepared) -> PoseEstimate:
        """Give a frame that shows the same picture as the one before it the same estimate.

        Unless that one could not be placed by what it shows: a robot may move over bare floor.
        """
        known = self._estimates[before.index]
        if known.status != "tracked":
            return self.lose(prepared, known.reason or f"same picture as {before.name}")
        self.links.append(
            Link(before.index, prepared.index, Pose2(), SAME_POSE_COVARIANCE, 0, 1.0, "step")
        )
        return self._keep(
            replace(
                known,
                index=prepared.index,
                name=prepared.name,
                stamp=prepared.stamp,
                reason=known.reason or f"same picture as {before.name}",
                revised=(),
            )
        )

    def lose(self, prepared: Prepared, reason: str) -> PoseEstimate:
        """Keep a frame that its picture does not place: predicted by odometry, or lost."""
        lacking = lost(prepared, reason)
        latest = self._latest_placed
        link = None if latest is None else self.senses.link(latest, lacking)
        if latest is None or link is None:
            return self._keep(lacking)
        assert latest.covariance is not None
        pose = self.pose(latest.index) @ link.a_from_b
        covariance = posegraph.compose_covariance(latest.covariance, link.a_from_b, link.covariance)
        predicted = _estimate(prepared, pose, latest.fragment, covariance)
        odom = self._odom_after(prepared, None)
        return self._keep(
            replace(predicted, status="predicted", reason=reason, odom_from_robot=odom)
        )

    def revise(self, index: int, others: tuple[int, ...]) -> PoseEstimate:
        """Note that a frame's coming changed the estimates of others."""
        known = self._estimates[index]
        return self._keep(replace(known, revised=(*known.revised, *others)))

    def solve(self) -> None:
        """Weigh all that is known, and number the fragments anew, the largest first.

        Fragments that links, odometry or GPS connect become one; each has its first frame as its
        origin. A frame that nothing ties to any other is lost; one that only odometry ties to the
        others is predicted.
        """
        parts = self._weighing.parts()
        linked = [part for part in parts if len(part) > 1] or parts[:1]
        for part in parts:
            if part not in linked:
                self._keep(lost(self._estimates[min(part)], "overlaps no other frame"))
        linked = self._weighing.tied_by_gps(linked)
        linked.sort(key=lambda part: (-len(part), min(part)))
        self.switched_off = frozenset()
        self.georeferences = {}
        for fragment, initial in enumerate(linked):
            self._solve(initial, fragment)

    @property
    def _weighing(self) -> Weighing:
        return Weighing(self.estimates, self.links, self.senses)

    def _keep(self, estimate: PoseEstimate) -> PoseEstimate:
        self._estimates[estimate.index] = estimate
        return estimate

    @property
    def _latest_placed(self) -> PoseEstimate | None:
        return next(
            (e for e in reversed(self._estimates.values()) if e.map_from_robot is not None), None
        )

    def _odom_after(self, prepared: Prepared, link: Link | None) -> Pose2:
        """Return ``odom_from_robot`` of a new frame: by its step, else odometry, else unmoved."""
        latest = self._latest_placed
        if latest is None or latest.odom_from_robot is None:
            return Pose2()
        if link is not None and link.kind == "step":
            origin = self._estimates[link.a]
            if origin.odom_from_robot is not None and origin.fragment == latest.fragment:
                return origin.odom_from_robot @ link.a_from_b
        felt = self.carried(latest.index, prepared)
        return latest.odom_from_robot if felt is None else latest.odom_from_robot @ felt[0]

    def _is_due(self) -> bool:
        """Return whether so many frames have come since the last solution that one is worth it."""
        return (
            self.senses.correct_the_map
            and len(self._estimates) > _SOLVE_AFTER_GROWTH * self._solved_at + _SOLVE_AFTER_FRAMES
        )

    def _join(self, index: int) -> None:
        """Re-solve the component that a frame belongs to."""
        part = next(part for part in self._weighing.parts() if index in part)
        self._solve(part, self._estimates[min(part)].fragment)
        self.revise(index, tuple(member for member in sorted(part) if member != index))

    def _solve(self, initial: dict[int, Pose2], fragment: int) -> None:
        """Solve one component, its first frame at the origin, and revise its estimates."""
        weighed = self._weighing.weigh(initial)
        solution = weighed.solution
        self._solved_at = len(self._estimates)
        self.switched_off = self.switched_off.difference(weighed.numbers) | weighed.switched_off
        used = set(weighed.numbers) - weighed.switched_off
        seen = {end for number in used for end in (self.links[number].a, self.links[number].b)}
        for index in initial:
            known = self._estimates[index]
            tracked = known.status == "tracked" or index in seen
            self._estimates[index] = replace(
                known,
                map_from_robot=solution.poses[index],
                covariance=solution.covariances[index],
                fragment=fragment,
                status="tracked" if tracked else "predicted",
                reason="" if tracked and known.status != "tracked" else known.reason,
            )
        if weighed.georeference is not None:
            self.georeferences[fragment] = weighed.georeference


def lost(frame: Prepared | PoseEstimate, reason: str) -> PoseEstimate:
    """Return the estimate of a frame that could not be placed."""
    return PoseEstimate(frame.index, frame.name, frame.stamp, None, "lost", reason)


def placed_fragments(estimates: Iterable[PoseEstimate]) -> dict[int, list[PoseEstimate]]:
    """Return the placed frames by fragment, the fragments by number."""
    fragments: dict[int, list[PoseEstimate]] = {}
    for estimate in estimates:
        if estimate.map_from_robot is not None:
            fragments.setdefault(estimate.fragment, []).append(estimate)
    return dict(sorted(fragments.items()))


def _estimate(
    prepared: Prepared, pose: Pose2, fragment: int, covariance: NDArray[np.float64]
) -> PoseEstimate:
    return PoseEstimate(
        prepared.index, prepared.name, prepared.stamp, pose, "tracked", "", fragment, covariance
    )


def _uncertainty(link: Link) -> float:
    return float(np.linalg.det(link.covariance))
