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
from slamcli.core.telemetry import Georeference
from slamcli.fusion import Senses
from slamcli.stages import posegraph

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from slamcli.core.records import Prepared

SAME_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])
# As a map grows by this share and so many frames, compass and GPS correct it again.
_SOLVE_AFTER_GROWTH = 1.25
_SOLVE_AFTER_FRAMES = 20
# A fragment so surely placed on Earth is tied to others that are.
_SURE_HEADING_RADIANS = 0.1
_SURE_PLACE_METRES = 1.0
# One less sure than this is not placed on Earth at all.
_LEAST_SURE_HEADING_RADIANS = 1.0
_TRUST = ("step", "odometry", "loop")


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
        return self._keep(
            _estimate(prepared, Pose2(), fragment, SAME_POSE_COVARIANCE),
        )

    def place(self, prepared: Prepared, links: Sequence[Link]) -> PoseEstimate:
        """Place a frame by the surest of its links; those to another fragment join the two."""
        link = min(links, key=_uncertainty)
        origin = self._estimates[link.a]
        assert origin.covariance is not None
        self.links += links
        pose = self.pose(link.a) @ link.a_from_b
        covariance = posegraph.compose_covariance(origin.covariance, link.a_from_b, link.covariance)
        placed = _estimate(prepared, pose, origin.fragment, covariance)
        odom = self._odom_after(prepared, link)
        self._keep(
            replace(placed, inliers=link.inliers, score=link.score, odom_from_robot=odom),
        )
        joins = any(self._estimates[link.a].fragment != origin.fragment for link in links)
        if joins or self._is_due():
            self._join(prepared.index)
        return self._estimates[prepared.index]

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
        groups = self._components()
        linked = [group for group in groups if len(group) > 1] or groups[:1]
        for group in groups:
            if group not in linked:
                self._keep(lost(self._estimates[group[0]], "overlaps no other frame"))
        parts = self._tied_by_gps([self._spread(group) for group in linked])
        parts.sort(key=lambda poses: (-len(poses), min(poses)))
        self.switched_off = frozenset()
        self.georeferences = {}
        for fragment, initial in enumerate(parts):
            self._solve(initial, fragment)

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

    def _components(self) -> list[list[int]]:
        """Return the frames that links and odometry connect, from the first placed one on."""
        chain = self.senses.chain(self.estimates)
        placed = {index for index in self._estimates if self.is_placed(index)}
        known = placed.union(*((link.a, link.b) for link in chain))
        groups = []
        for group in posegraph.components(sorted(known), [*self.links, *chain]):
            first = next((index for index in group if index in placed), None)
            if first is not None:
                groups.append([index for index in group if index >= first])
        return groups

    def _join(self, index: int) -> None:
        """Re-solve the component that a frame belongs to."""
        group = next(group for group in self._components() if index in group)
        self._solve(self._spread(group), self._estimates[group[0]].fragment)
        self.revise(index, tuple(member for member in group if member != index))

    def _tied_by_gps(self, parts: list[dict[int, Pose2]]) -> list[dict[int, Pose2]]:
        """Return first poses of the parts, those that GPS places on Earth surely made one."""
        if len(parts) < 2 or self.senses.datum_degrees is None:
            return parts
        together: dict[int, Pose2] = {}
        apart = []
        for initial in parts:
            solution = self._weigh(initial)[0]
            offsets = solution.offsets
            sigmas = np.sqrt(np.diag(offsets.east_north_covariance))
            if sigmas[2] < _SURE_HEADING_RADIANS and sigmas[:2].max() < _SURE_PLACE_METRES:
                here = offsets.east_north_from_map
                together.update((k, here @ pose) for k, pose in solution.poses.items())
            else:
                apart.append(initial)
        if not together:
            return apart
        back = together[min(together)].inverse()
        return [{k: back @ together[k] for k in sorted(together)}, *apart]

    def _solve(self, initial: dict[int, Pose2], fragment: int) -> None:
        """Solve one component, its first frame at the origin, and revise its estimates."""
        solution, numbers, readings = self._weigh(initial)
        self._solved_at = len(self._estimates)
        off = {numbers[k] for k in solution.switched_off if k < len(numbers)}
        self.switched_off = self.switched_off.difference(numbers) | off
        seen = {k for n in set(numbers) - off for k in (self.links[n].a, self.links[n].b)}
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
        self._georeference(fragment, solution, readings)

    def _weigh(self, initial: dict[int, Pose2]) -> tuple[posegraph.Solution, list[int], int]:
        """Return a component's solution, the places of its links, and how many GPS readings."""
        numbers = [n for n, link in enumerate(self.links) if link.a in initial]
        frames = [
            replace(self._estimates[index], map_from_robot=initial[index], fragment=0)
            for index in sorted(initial)
        ]
        places = self.senses.places(frames)
        solution = posegraph.solve(
            initial,
            [self.links[n] for n in numbers] + self.senses.chain(frames),
            self.senses.headings(frames),
            places,
            lever_arm_metres=self.senses.options.lever_arm_metres,
        )
        return solution, numbers, len(places)

    def _georeference(self, fragment: int, solution: posegraph.Solution, readings: int) -> None:
        offsets, datum = solution.offsets, self.senses.datum_degrees
        heading_sigma = float(np.sqrt(offsets.east_north_covariance[2, 2]))
        if datum is None or not readings or heading_sigma > _LEAST_SURE_HEADING_RADIANS:
            return
        self.georeferences[fragment] = Georeference(
            datum,
            offsets.east_north_from_map,
            offsets.east_north_covariance,
            offsets.lever_arm_metres,
            readings,
            len(solution.places_off),
        )

    def _spread(self, group: list[int]) -> dict[int, Pose2]:
        """Return first poses for a component, walked from its first frame.

        Along steps where they lead, else odometry, else loops: these alone may be false.
        """
        members = set(group)
        links = [link for link in self.links if link.a in members]
        links += self.senses.chain([self._estimates[index] for index in group])
        links.sort(key=lambda link: _TRUST.index(link.kind))
        neighbours: dict[int, list[tuple[int, Pose2]]] = {index: [] for index in group}
        for link in posegraph.spanning(group, links):
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
