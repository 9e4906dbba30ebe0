"""The keyframes of a map that see the floor at a pose, by the map's poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamcli.core.geometry import Pose2, pose_array, relative_poses
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.stages import covisibility


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
        apart = np.linalg.norm(self._poses[:, :2] - here[:2], axis=1)
        reach = 2.0 * (self._footprint.radius_metres + np.linalg.norm(self._footprint.centre))
        close = np.flatnonzero(apart < reach)
        motions = relative_poses(self._poses[close], here)
        shares = self._footprint.overlaps(motions)
        best = np.argsort(-shares, kind="stable")[:count]
        return [
            (self._indices[close[number]], Pose2(*motions[number].tolist()))
            for number in best
            if shares[number] >= min_overlap
        ]
