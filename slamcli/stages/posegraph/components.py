"""Connected components and spanning trees of the pose graph, by disjoint sets (Tarjan, 1975)."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.cluster.hierarchy import DisjointSet

from slamcli.core.records import Link


def components(indices: Sequence[int], links: Sequence[Link]) -> list[list[int]]:
    """Return the frames that links connect, as sorted lists, by their first frame."""
    sets = DisjointSet(indices)
    for link in links:
        sets.merge(link.a, link.b)
    return sorted(sorted(subset) for subset in sets.subsets())


def spanning(indices: Sequence[int], links: Sequence[Link]) -> list[Link]:
    """Return the first links, in the order given, that connect all that they do (Kruskal, 1956)."""
    sets = DisjointSet(indices)
    return [link for link in links if sets.merge(link.a, link.b)]
