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
from slamcli.stages import posegraph

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from slamcli.core.records import Prepared

SAME_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])


class Graph:
    """Frames by index, each with its estimate, and the links that tie them."""

    def __init__(self) -> None:
        self.links: list[Link] = []
        self._estimates: dict[int, PoseEstimate] = {}
        self._next_fragment = 0

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

    def begin_fragment(self, prepared: Prepared) -> PoseEstimate:
        """Make a frame the origin of a map of its own."""
        fragment = self._next_fragment
        self._next_fragment += 1
        return self._keep(
            _estimate(prepared, Pose2(), fragment, SAME_POSE_COVARIANCE),
        )

    def adopt(self, estimate: PoseEstimate) -> None:
        """Take over what an earlier run knew of a frame."""
        self._keep(estimate)
        self._next_fragment = max(self._next_fragment, estimate.fragment + 1)

    def place(self, prepared: Prepared, links: Sequence[Link]) -> PoseEstimate:
        """Place a frame by the surest of its links; those to another fragment join the two."""
        self._keep(self.where(prepared, links))
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
        if any(self._estimates[link.a].fragment != fragment for link in links):
            self._join(index)

    def repeat(self, before: Prepared, prepared: Prepared) -> PoseEstimate:
        """Give a frame that shows the same picture as the one before it the same estimate."""
        known = self._estimates[before.index]
        if known.map_from_robot is not None:
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
        """Keep a frame that could not be placed, with the reason."""
        return self._keep(lost(prepared, reason))

    def revise(self, index: int, others: tuple[int, ...]) -> PoseEstimate:
        """Note that a frame's coming changed the estimates of others."""
        known = self._estimates[index]
        return self._keep(replace(known, revised=(*known.revised, *others)))

    def solve(self) -> None:
        """Weigh all links against one another, and number the fragments anew, the largest first.

        Fragments that links connect become one; each has its first frame as its origin. A frame
        that nothing ties to any other is lost.
        """
        groups = self._components()
        linked = [group for group in groups if len(group) > 1] or groups[:1]
        for group in groups:
            if group not in linked:
                self._keep(lost(self._estimates[group[0]], "overlaps no other frame"))
        linked.sort(key=lambda group: (-len(group), group[0]))
        for fragment, group in enumerate(linked):
            self._solve(group, fragment)

    def _keep(self, estimate: PoseEstimate) -> PoseEstimate:
        self._estimates[estimate.index] = estimate
        return estimate

    def _components(self) -> list[list[int]]:
        placed = [index for index in self._estimates if self.is_placed(index)]
        return posegraph.components(placed, self.links)

    def _join(self, index: int) -> None:
        """Re-solve the component that a link between two fragments has just connected."""
        group = next(group for group in self._components() if index in group)
        self._solve(group, self._estimates[group[0]].fragment)
        self.revise(index, tuple(member for member in group if member != index))

    def _solve(self, group: list[int], fragment: int) -> None:
        """Solve one component, its first frame at the origin, and revise its estimates."""
        initial = self._spread(group)
        members = set(group)
        solution = posegraph.solve(initial, [link for link in self.links if link.a in members])
        for index in group:
            self._estimates[index] = replace(
                self._estimates[index],
                map_from_robot=solution.poses[index],
                covariance=solution.covariances[index],
                fragment=fragment,
            )

    def _spread(self, group: list[int]) -> dict[int, Pose2]:
        """Return first poses for a component by walking its links from its first frame."""
        neighbours: dict[int, list[tuple[int, Pose2]]] = {index: [] for index in group}
        for link in self.links:
            if link.a in neighbours:
                neighbours[link.a].append((link.b, link.a_from_b))
                neighbours[link.b].append((link.a, link.a_from_b.inverse()))
        poses = {group[0]: Pose2()}
        queue = [group[0]]
        for index in queue:
            for other, pose in neighbours[index]:
                if other not in poses:
                    poses[other] = poses[index] @ pose
                    queue.append(other)
        return poses


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
