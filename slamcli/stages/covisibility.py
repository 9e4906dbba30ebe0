"""Covisibility: which frames see the same floor, by their poses and these poses' uncertainty."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csgraph, csr_array
from scipy.spatial import ConvexHull, KDTree

from slamcli.core.arrays import BoolArray, Float64Array, Int64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.geometry import compose_poses, relative_poses

# Overlaps differ from those of the views by less than 0.06.
# [guarded by tests/mapping/test_loop_closure.py]
_SAMPLES_A_SIDE = 14
# Frames whose distances in the graph are computed at a time: bounds the memory.
_FRAMES_AT_ONCE = 64


class Footprint:
    """The floor that a camera sees: a convex outline, and sample points that fill it evenly.

    Parameters
    ----------
    calibration : Calibration
    """

    def __init__(self, calibration: Calibration) -> None:
        hull = ConvexHull(footprint_hull(calibration))
        corners = hull.points[hull.vertices]
        # A row of points is inside between the outline's left and right sides, functions of y.
        lowest, highest = int(np.argmin(corners[:, 1])), int(np.argmax(corners[:, 1]))
        turned, up = np.roll(corners, -lowest, axis=0), (highest - lowest) % len(corners)
        self._right = _rising(turned[: up + 1], outward=1.0)
        self._left = _rising(np.vstack([turned[up:], turned[:1]]), outward=-1.0)
        low, high = corners.min(axis=0), corners.max(axis=0)
        steps = (np.arange(_SAMPLES_A_SIDE) + 1.0) / (_SAMPLES_A_SIDE + 1.0)
        x, y = np.meshgrid(*(low[axis] + steps * (high - low)[axis] for axis in (0, 1)))
        lattice = np.column_stack([x.ravel(), y.ravel()])
        self._points = lattice[self._inside(*lattice.T)]
        self.centre = self._points.mean(axis=0)
        self.radius_metres = float(np.linalg.norm(corners - self.centre, axis=1).max())

    def overlaps(self, a_from_b: Float64Array) -> Float64Array:
        """Return the shares of b's floor that a sees too, for (N, 3) motions x, y, theta."""
        cosine, sine = np.cos(a_from_b[:, 2:]), np.sin(a_from_b[:, 2:])
        x, y = self._points.T
        across = cosine * x - sine * y + a_from_b[:, :1]
        along = sine * x + cosine * y + a_from_b[:, 1:2]
        shares: Float64Array = self._inside(across, along).mean(axis=-1)
        return shares

    def _inside(self, x: Float64Array, y: Float64Array) -> BoolArray:
        """Return (...): whether points lie within the outline."""
        left, right = (np.interp(y, side[:, 1], side[:, 0]) for side in (self._left, self._right))
        between = (left <= x) & (x <= right)
        return np.asarray(between & (y >= self._left[0, 1]) & (y <= self._left[-1, 1]))


def _rising(side: Float64Array, *, outward: float) -> Float64Array:
    """Return the corners (N, 2) of one side of an outline, from the lowest up.

    Of several at one y, at the ends of a level edge, the outermost.
    """
    ordered = side[np.lexsort((-outward * side[:, 0], side[:, 1]))]
    return np.asarray(ordered[np.unique(ordered[:, 1], return_index=True)[1]])


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The earlier frames that see floor of one frame, b.

    Attributes
    ----------
    b : int
        Index in the given arrays.
    a : (N,) int64
        Indices of the others, most overlap first.
    a_from_b : (N, 3) float64
    uncertainties : (N,) float64
        Sigma of the motion, metres.
    """

    b: int
    a: Int64Array
    a_from_b: Float64Array
    uncertainties: Float64Array


def pairs(
    poses: Float64Array,
    links: Int64Array,
    uncertainties: Float64Array,
    footprint: Footprint,
    *,
    min_overlap: float,
    max_uncertainty: float,
) -> Iterator[Pairs]:
    """Yield, for each frame, the earlier ones that see enough of its floor by the poses.

    The sigma between two poses is the sum along the shortest path of links between them: an upper
    bound, as a calibration's errors add up and noise does less. The cost of a frame depends on the
    number of frames near it, not on the size of the map.

    Parameters
    ----------
    poses : (N, 3) float64
        ``map_from_robot`` of one fragment's frames in their order.
    links : (M, 2) int64
        Pairs of indices in `poses` that links connect.
    uncertainties : (M,) float64
        Sigma of each link, metres.
    footprint : Footprint
    min_overlap : float
        Share of b's floor.
    max_uncertainty : float
        Sigma, in metres, beyond which the poses of two frames do not determine their motion.
    """
    middles = compose_poses(poses, np.array([*footprint.centre, 0.0]))[:, :2]
    tree = KDTree(middles)
    # A sparse zero would be no link.
    steps = np.maximum(uncertainties, 1e-12)
    graph = csr_array((steps, (links[:, 0], links[:, 1])), shape=(len(poses), len(poses)))
    for first in range(0, len(poses), _FRAMES_AT_ONCE):
        chunk = np.arange(first, min(first + _FRAMES_AT_ONCE, len(poses)))
        reach = csgraph.dijkstra(graph, directed=False, indices=chunk, limit=max_uncertainty)
        for b, sigmas in zip(chunk, reach, strict=True):
            near = tree.query_ball_point(middles[b], 2.0 * footprint.radius_metres)
            earlier = np.array([a for a in near if a < b and np.isfinite(sigmas[a])], np.int64)
            motions = relative_poses(poses[earlier], poses[b])
            shares = footprint.overlaps(motions)
            order = np.lexsort((earlier, -shares))
            order = order[shares[order] >= min_overlap]
            yield Pairs(int(b), earlier[order], motions[order], sigmas[earlier[order]])
