"""The keyframes of a map that see the floor at a pose, by the map's poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2, compose_poses, pose_array, relative_poses
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.stages import covisibility

# Overlaps are computed of those whose middles are nearest: about a pose in a map that was driven
# over many times there are hundreds [guarded by benchmarks/locate.py].
_MAX_COMPARED = 16
# Overlaps that differ by less are about equal [guarded by benchmarks/locate.py].
_EQUAL_SHARES = 0.1


class NearKeyframes:
    """Keyframes whose poses do not change, by the share of a pose's floor that they see.

    Parameters
    ----------
    footprint : Footprint
        Of the camera.
    indices : sequence of int
        The keyframes, which are placed.
    graph : PoseGraphReader
    """

    def __init__(
        self, footprint: covisibility.Footprint, indices: Sequence[int], graph: PoseGraphReader
    ) -> None:
        self._footprint = footprint
        self._indices = indices
        self._poses = pose_array([graph.pose(index) for index in indices])
        self._middles = self._middles_of(self._poses)

    def find(self, near: Pose2, count: int, min_overlap: float) -> list[tuple[int, Pose2]]:
        """Return a few keyframes, most overlap first, each with ``keyframe_from_robot``.

        Parameters
        ----------
        near : Pose2
            ``map_from_robot``.
        count : int
            Most keyframes.
        min_overlap : float
            Least share of the floor at the pose that they see.
        """
        here = pose_array([near])[0]
        away = self._middles - self._middles_of(here[None])
        squared = np.einsum("ij,ij->i", away, away)
        close = np.flatnonzero(squared < (2.0 * self._footprint.radius_metres) ** 2)
        close = close[np.argsort(squared[close], kind="stable")[:_MAX_COMPARED]]
        motions = relative_poses(self._poses[close], here)
        shares = self._footprint.overlaps(motions)
        # Of about equal ones the earliest, so that the next frame of a robot that moves a little is
        # registered to the same, which is decoded already.
        rounded = np.round(shares / _EQUAL_SHARES)
        best = np.lexsort((close, -rounded))[:count]
        return [
            (self._indices[close[number]], Pose2(*motions[number].tolist()))
            for number in best
            if shares[number] >= min_overlap
        ]

    def _middles_of(self, poses: Float64Array) -> Float64Array:
        """Return (N, 2), metres: the middle of the floor that the camera sees at (N, 3) poses."""
        return compose_poses(poses, np.array([*self._footprint.centre, 0.0]))[:, :2]
