"""The pose graph: one estimate per frame, and the links (edges) between frames.

The only owner of the graph's state. `Backend` inserts into it and applies the results of the
optimisers; all others read it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate, PreparedFrame
from slamcli.core.telemetry import Georeference
from slamcli.mapping.saved_state import GraphState
from slamcli.stages import posegraph


@dataclass(frozen=True, slots=True, eq=False)
class GraphUpdate:
    """Result of an optimisation of one fragment, or of a part of it.

    Attributes
    ----------
    fragment : int
    estimates : tuple of PoseEstimate
        Of the optimised frames.
    links : tuple of int
        Indices of the links that were used.
    switched_off : frozenset of int
        Those of them that the others contradict.
    offsets : posegraph.SensorOffsets
    georeference : Georeference or None
        None when GPS does not determine it.
    """

    fragment: int
    estimates: tuple[PoseEstimate, ...]
    links: tuple[int, ...]
    switched_off: frozenset[int]
    offsets: posegraph.SensorOffsets
    georeference: Georeference | None


class PoseGraphReader(Protocol):
    """What loop closure, relocalisation and the motion model read of a pose graph."""

    @property
    def links(self) -> Sequence[Link]:
        """All links, in the order of insertion."""
        ...

    @property
    def switched_off(self) -> frozenset[int]:
        """Indices of the links that the others contradict, as of the latest solution."""
        ...

    def __getitem__(self, index: int) -> PoseEstimate:
        """Return a frame's estimate."""
        ...

    def get(self, index: int) -> PoseEstimate | None:
        """Return a frame's estimate, or None when there is no such frame."""
        ...

    def pose(self, index: int) -> Pose2:
        """Return ``map_from_robot`` of a frame that is placed."""
        ...

    def is_placed(self, index: int) -> bool:
        """Return whether a frame has a pose."""
        ...


class PoseGraph:
    """Frames by index, each with its estimate, and the links between them.

    Attributes
    ----------
    order : list of int
        The frames in the order of insertion.
    links_before : list of int
        Number of links that were there before each of these.
    switched_off : frozenset of int
        Indices of the links that the others contradict, as of the latest solution.
    georeferences : dict of int to Georeference
        Of each fragment that GPS determines, as of the latest solution.
    offsets : dict of int to posegraph.SensorOffsets
        Of each optimised fragment, as of its latest solution.
    """

    def __init__(self) -> None:
        self.order: list[int] = []
        self.links_before: list[int] = []
        self.switched_off: frozenset[int] = frozenset()
        self.georeferences: dict[int, Georeference] = {}
        self.offsets: dict[int, posegraph.SensorOffsets] = {}
        self._links: list[Link] = []
        self._estimates: dict[int, PoseEstimate] = {}
        self._next_index = 0

    def __contains__(self, index: int) -> bool:
        return index in self._estimates

    def __getitem__(self, index: int) -> PoseEstimate:
        return self._estimates[index]

    def get(self, index: int) -> PoseEstimate | None:
        """Return a frame's estimate, or None when there is no such frame."""
        return self._estimates.get(index)

    @property
    def links(self) -> Sequence[Link]:
        """All links, in the order of insertion."""
        return self._links

    @property
    def estimates(self) -> list[PoseEstimate]:
        """One for every frame so far, sorted by index."""
        return [self._estimates[index] for index in sorted(self._estimates)]

    @property
    def next_index(self) -> int:
        """One more than the largest frame index."""
        return self._next_index

    def pose(self, index: int) -> Pose2:
        """Return ``map_from_robot`` of a frame that is placed."""
        pose = self._estimates[index].map_from_robot
        assert pose is not None
        return pose

    def is_placed(self, index: int) -> bool:
        """Return whether a frame has a pose."""
        return self._estimates[index].map_from_robot is not None

    @property
    def latest_placed(self) -> PoseEstimate | None:
        """The latest frame that has a pose."""
        return next(
            (e for e in reversed(self._estimates.values()) if e.map_from_robot is not None), None
        )

    def placed_before(self, count: int, fragment: int, max_frames: int) -> int | None:
        """Return the latest frame of a fragment that is placed, among the first `count` frames.

        Only the last `max_frames` of these are searched; None when there is none among them.
        """
        return next(
            (
                member
                for member in reversed(self.order[max(0, count - max_frames) : count])
                if self.is_placed(member) and self._estimates[member].fragment == fragment
            ),
            None,
        )

    def predict_pose(self, prepared: PreparedFrame, links: Sequence[Link]) -> PoseEstimate:
        """Return the estimate of a new frame by the most certain of its links to known frames."""
        link = most_certain(links)
        origin = self[link.a]
        placed = tracked(prepared, *self.compose(link), origin.fragment)
        return replace(placed, inliers=link.inliers, score=link.score)

    def compose(self, link: Link) -> tuple[Pose2, Float64Array]:
        """Return ``map_from_b`` of a link from a placed frame, and its (3, 3) covariance."""
        origin = self[link.a].covariance
        assert origin is not None
        covariance = posegraph.compose_covariance(origin, link.a_from_b, link.covariance)
        return self.pose(link.a) @ link.a_from_b, covariance

    def set_estimate(self, estimate: PoseEstimate) -> PoseEstimate:
        """Insert a frame, or replace its estimate; return the estimate."""
        if estimate.index not in self._estimates:
            self.order.append(estimate.index)
            self.links_before.append(len(self._links))
            self._next_index = max(self._next_index, estimate.index + 1)
        self._estimates[estimate.index] = estimate
        return estimate

    def add_links(self, links: Iterable[Link]) -> None:
        """Append links between frames."""
        self._links += links

    def apply(self, update: GraphUpdate) -> None:
        """Take over the result of an optimisation."""
        for estimate in update.estimates:
            self.set_estimate(estimate)
        self.switched_off = self.switched_off.difference(update.links) | update.switched_off
        self.offsets[update.fragment] = update.offsets
        if update.georeference is not None:
            self.georeferences[update.fragment] = update.georeference

    def state(self) -> GraphState:
        """Return all that `restore` needs."""
        return GraphState(
            tuple(self._estimates.values()),
            self.links_before,
            self._links,
            tuple(sorted(self.switched_off)),
            self.georeferences,
            self.offsets,
        )

    def restore(self, state: GraphState) -> None:
        """Take over the state of another graph in place of its own."""
        self._estimates = {estimate.index: estimate for estimate in state.estimates}
        self.order = list(self._estimates)
        self.links_before = list(state.links_before)
        self._links = list(state.links)
        self.switched_off = frozenset(state.switched_off)
        self.georeferences = dict(state.georeferences)
        self.offsets = dict(state.offsets)
        self._next_index = max(self.order, default=-1) + 1

    def clear_solution(self) -> None:
        """Discard all that optimisations found but the poses: every fragment is solved anew."""
        self.switched_off = frozenset()
        self.georeferences = {}
        self.offsets = {}


def lost(frame: PreparedFrame | PoseEstimate, reason: str) -> PoseEstimate:
    """Return the estimate of a frame that could not be placed."""
    return PoseEstimate(frame.index, frame.name, frame.stamp, None, "lost", reason)


def tracked(
    prepared: PreparedFrame, pose: Pose2, covariance: Float64Array, fragment: int
) -> PoseEstimate:
    """Return the estimate of a frame that is placed."""
    return PoseEstimate(
        prepared.index, prepared.name, prepared.stamp, pose, "tracked", "", fragment, covariance
    )


def most_certain(links: Sequence[Link]) -> Link:
    """Return the link whose covariance has the smallest determinant (D-optimality)."""
    return min(links, key=lambda link: float(np.linalg.det(link.covariance)))


def placed_fragments(estimates: Iterable[PoseEstimate]) -> dict[int, list[PoseEstimate]]:
    """Return the placed frames by fragment, the fragments by number."""
    fragments: dict[int, list[PoseEstimate]] = {}
    for estimate in estimates:
        if estimate.map_from_robot is not None:
            fragments.setdefault(estimate.fragment, []).append(estimate)
    return dict(sorted(fragments.items()))
