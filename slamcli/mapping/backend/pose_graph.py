"""What is known of a drive: every frame's estimate, in the order of their coming, and the links."""

from __future__ import annotations

from collections.abc import Iterable

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate


class PoseGraph:
    """Frames by index, each with its estimate, and the links that tie them.

    Attributes
    ----------
    links : list of Link
    order : list of int
        The frames as they came.
    links_before : list of int
        How many links there were before each of these.
    """

    def __init__(self) -> None:
        self.links: list[Link] = []
        self.order: list[int] = []
        self.links_before: list[int] = []
        self._estimates: dict[int, PoseEstimate] = {}
        self._next_index = 0

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

    @property
    def latest_placed(self) -> PoseEstimate | None:
        """The latest frame that has a pose."""
        return next(
            (e for e in reversed(self._estimates.values()) if e.map_from_robot is not None), None
        )

    def placed_before(self, count: int, fragment: int, most: int) -> int | None:
        """Return the latest placed one of so many first frames, if it is of a fragment.

        Only the latest few of them are looked at.
        """
        return next(
            (
                member
                for member in reversed(self.order[max(0, count - most) : count])
                if self.is_placed(member) and self._estimates[member].fragment == fragment
            ),
            None,
        )

    def set_estimate(self, estimate: PoseEstimate) -> PoseEstimate:
        """Take over what is known of a frame now."""
        if estimate.index not in self._estimates:
            self.order.append(estimate.index)
            self.links_before.append(len(self.links))
            self._next_index = max(self._next_index, estimate.index + 1)
        self._estimates[estimate.index] = estimate
        return estimate


def placed_fragments(estimates: Iterable[PoseEstimate]) -> dict[int, list[PoseEstimate]]:
    """Return the placed frames by fragment, the fragments by number."""
    fragments: dict[int, list[PoseEstimate]] = {}
    for estimate in estimates:
        if estimate.map_from_robot is not None:
            fragments.setdefault(estimate.fragment, []).append(estimate)
    return dict(sorted(fragments.items()))
