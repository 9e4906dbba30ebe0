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
    from slamcli.weighing import Weighed

SAME_POSE_COVARIANCE = np.diag([1e-12, 1e-12, 1e-12])
# While a map is smaller than this, or what compass and GPS are off by is not known yet, it is
# solved anew as it grows by this share and so many frames.
_SMALL_FRAMES = 400
_SOLVE_AFTER_GROWTH = 1.25
_SOLVE_AFTER_FRAMES = 20
# From then on only the frames that came since are, whenever so many have: that cost stays flat.
_WINDOW_FRAMES = 50


class Graph:
    """Frames by index, each with its estimate, and the links that tie them."""

    def __init__(self, senses: Senses | None = None) -> None:
        self.links: list[Link] = []
        self.senses = senses or Senses()
        self.switched_off: frozenset[int] = frozenset()
        self.georeferences: dict[int, Georeference] = {}
        self._estimates: dict[int, PoseEstimate] = {}
        self._next_fragment = 0
        self._next_index = 0
        # The frames in the order of their coming, and how many links there were before each.
        self._order: list[int] = []
        self._links_before: list[int] = []
        self._offsets: dict[int, posegraph.SenseOffsets] = {}
        # How many frames there were at the latest solution, and at the latest of the whole map.
        self._solved_at = 0
        self._all_solved_at = 0

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
        return self._next_index

    def pose(self, index: int) -> Pose2:
        """Return ``map_from_robot`` of a frame that is placed."""
        pose = self._estimates[index].map_from_robot
        assert pose is not None
        return pose

    def is_placed(self, index: int) -> bool:
        """Return whether a frame has a pose."""
        return self._estimates[index].map_from_robot is not None

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
        elif self._is_window_full():
            self._slide(index)

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
        kept = self._keep(
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

    def lose(self, prepared: Prepared, reason: str, partial: Link | None = None) -> PoseEstimate:
        """Keep a frame that its picture does not place: predicted by odometry, or lost.

        Parameters
        ----------
        prepared : Prepared
        reason : str
        partial : Link or None
            To a placed frame: what the picture tells of some directions. Odometry fills the others.
        """
        lacking = lost(prepared, reason)
        latest = self._latest_placed if partial is None else self._estimates[partial.a]
        link = None if latest is None else self.senses.link(latest, lacking)
        if latest is None or link is None:
            return self._keep(lacking)
        if partial is not None:
            self.links.append(partial)
            link = posegraph.fuse(link, partial)
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
        self._offsets = {}
        for fragment, initial in enumerate(linked):
            self._solve(initial, fragment)

    @property
    def _weighing(self) -> Weighing:
        return Weighing(self.estimates, self.links, self.senses)

    def _keep(self, estimate: PoseEstimate) -> PoseEstimate:
        if estimate.index not in self._estimates:
            self._order.append(estimate.index)
            self._links_before.append(len(self.links))
            self._next_index = max(self._next_index, estimate.index + 1)
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
        """Return whether so many frames have come since the whole was solved that it is worth it.

        Of a large map whose senses are settled, only the latest frames are, and the whole at last.
        """
        if not self.senses.correct_the_map:
            return False
        settled = all(map(self.senses.are_settled, self._offsets.values())) and self._offsets
        if settled and len(self._order) > _SMALL_FRAMES:
            return False
        grown = _SOLVE_AFTER_GROWTH * self._all_solved_at + _SOLVE_AFTER_FRAMES
        return len(self._order) > grown

    def _is_window_full(self) -> bool:
        waiting = len(self._order) - self._solved_at
        return self.senses.correct_the_map and waiting >= _WINDOW_FRAMES

    def _slide(self, index: int) -> None:
        """Solve a frame's fragment from where the latest solution ended, all before that held.

        A fixed-lag smoother (Dellaert and Kaess, Factor Graphs for Robot Perception, 2017) whose
        windows do not overlap: what their readings tell of the senses' offsets adds up.
        """
        fragment, first = self._estimates[index].fragment, self._solved_at
        members = [
            member
            for member in self._order[first:]
            if self.is_placed(member) and self._estimates[member].fragment == fragment
        ]
        prior = self._offsets.get(fragment)
        base = self._placed_before(first, fragment)
        if prior is None or base is None:
            return
        free = set(members)
        numbers = [
            number
            for number in range(self._links_before[first], len(self.links))
            if not free.isdisjoint((self.links[number].a, self.links[number].b))
            and self._estimates[self.links[number].a].fragment == fragment
            and self._estimates[self.links[number].b].fragment == fragment
        ]
        links = [self.links[number] for number in numbers]
        held = {base} | {end for link in links for end in (link.a, link.b)} - free
        frames = [self._estimates[member] for member in sorted(held | free)]
        weighing = Weighing(frames, links, self.senses)
        weighed = weighing.weigh({f.index: self.pose(f.index) for f in frames}, held, prior)
        off = frozenset(numbers[place] for place in weighed.switched_off)
        self.switched_off = self.switched_off.difference(numbers) | off
        self._revise_window(members, base, weighed.solution)
        self._offsets[fragment] = weighed.solution.offsets
        self._locate_on_earth(fragment, weighed, self.georeferences.get(fragment))
        self._solved_at = len(self._order)
        self.revise(index, tuple(member for member in sorted(free) if member != index))

    def _placed_before(self, count: int, fragment: int) -> int | None:
        """Return the latest placed one of so many first frames, if it is of a fragment."""
        return next(
            (
                member
                for member in reversed(self._order[max(0, count - _SMALL_FRAMES) : count])
                if self.is_placed(member) and self._estimates[member].fragment == fragment
            ),
            None,
        )

    def _revise_window(self, members: list[int], base: int, solution: posegraph.Solution) -> None:
        """Take over poses that were solved with others held, of which one is surely known."""
        known = self._estimates[base].covariance
        assert known is not None
        for member in members:
            pose = solution.poses[member]
            covariance = posegraph.compose_covariance(
                known, self.pose(base).inverse() @ pose, solution.covariances[member]
            )
            self._estimates[member] = replace(
                self._estimates[member], map_from_robot=pose, covariance=covariance
            )

    def _locate_on_earth(
        self, fragment: int, weighed: Weighed, before: Georeference | None = None
    ) -> None:
        found = weighed.georeference
        if found is not None and before is not None:
            readings = found.readings + before.readings
            outliers = found.outliers + before.outliers
            # A window takes older poses for certain; the sigmas of the whole hold their errors too.
            found = replace(
                found, covariance=before.covariance, readings=readings, outliers=outliers
            )
        if found is not None:
            self.georeferences[fragment] = found

    def _join(self, index: int) -> None:
        """Re-solve the component that a frame belongs to."""
        part = next(part for part in self._weighing.parts() if index in part)
        self._solve(part, self._estimates[min(part)].fragment)
        self.revise(index, tuple(member for member in sorted(part) if member != index))

    def _solve(self, initial: dict[int, Pose2], fragment: int) -> None:
        """Solve one component, its first frame at the origin, and revise its estimates."""
        weighed = self._weighing.weigh(initial)
        solution = weighed.solution
        self._solved_at = self._all_solved_at = len(self._order)
        self._offsets[fragment] = solution.offsets
        self.switched_off = self.switched_off.difference(weighed.numbers) | weighed.switched_off
        used = set(weighed.numbers) - weighed.switched_off
        shown = [self.links[n] for n in used if self.links[n].kind not in {"odometry", "partial"}]
        seen = {end for link in shown for end in (link.a, link.b)}
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
        self._locate_on_earth(fragment, weighed)


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
