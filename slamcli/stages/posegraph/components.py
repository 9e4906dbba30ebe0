"""What hangs together: disjoint sets of frames, merged link by link (Tarjan, 1975)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from slamcli.core.records import Link


class Sets:
    """Disjoint sets, each named by its least member."""

    def __init__(self, members: Iterable[int]) -> None:
        self._parent = {member: member for member in members}

    def root(self, member: int) -> int:
        """Return the least member of the set that a member belongs to."""
        parent = self._parent
        while parent[member] != member:
            parent[member] = parent[parent[member]]
            member = parent[member]
        return member

    def merge(self, first: int, second: int) -> bool:
        """Make two sets one; return whether they were two."""
        low, high = sorted((self.root(first), self.root(second)))
        self._parent[high] = low
        return low != high

    def groups(self) -> list[list[int]]:
        """Return the sets as sorted lists, by their least member."""
        groups: dict[int, list[int]] = {}
        for member in sorted(self._parent):
            groups.setdefault(self.root(member), []).append(member)
        return [groups[key] for key in sorted(groups)]


def components(indices: Sequence[int], links: Sequence[Link]) -> list[list[int]]:
    """Return the frames that links connect, as sorted lists, by their first frame."""
    sets = Sets(indices)
    for link in links:
        sets.merge(link.a, link.b)
    return sets.groups()


def spanning(indices: Sequence[int], links: Sequence[Link]) -> list[Link]:
    """Return the first links, in the order given, that connect all that they do (Kruskal, 1956)."""
    sets = Sets(indices)
    return [link for link in links if sets.merge(link.a, link.b)]
