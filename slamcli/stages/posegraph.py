"""All links of a map weighed against one another: poses that fit them best, and how sure they are.

A pose graph over SE(2) solved by Levenberg-Marquardt in GTSAM (Dellaert and Kaess, Factor Graphs
for Robot Perception, 2017). GTSAM is imported here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import Pose2

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from slamcli.core.records import Link

# The first frame defines the map, so it is held this firmly (m, m, rad).
_ANCHOR_SIGMA = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Solved poses.

    Attributes
    ----------
    poses : dict of int to Pose2
        ``map_from_robot`` by frame index.
    covariances : dict of int to (3, 3) float64
        Marginal, of x, y (m), theta (rad), in the robot's own axes.
    """

    poses: dict[int, Pose2]
    covariances: dict[int, NDArray[np.float64]]


def components(indices: Sequence[int], links: Sequence[Link]) -> list[list[int]]:
    """Return the frames that links connect, as sorted lists, by their first frame."""
    parent = {index: index for index in indices}

    def root(index: int) -> int:
        while parent[index] != index:
            parent[index] = parent[parent[index]]
            index = parent[index]
        return index

    for link in links:
        low, high = sorted((root(link.a), root(link.b)))
        parent[high] = low
    groups: dict[int, list[int]] = {}
    for index in sorted(indices):
        groups.setdefault(root(index), []).append(index)
    return [groups[key] for key in sorted(groups)]


def solve(initial: Mapping[int, Pose2], links: Sequence[Link]) -> Solution:
    """Solve one connected component, its first frame held where it is.

    Parameters
    ----------
    initial : mapping of frame index to ``map_from_robot``
    links : sequence of Link
        Only between frames of `initial`.
    """
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    for index, pose in initial.items():
        values.insert(index, gtsam.Pose2(pose.x, pose.y, pose.theta))
    anchor = min(initial)
    firm = gtsam.noiseModel.Isotropic.Sigma(3, _ANCHOR_SIGMA)
    graph.add(gtsam.PriorFactorPose2(anchor, values.atPose2(anchor), firm))
    for link in links:
        noise = gtsam.noiseModel.Gaussian.Covariance(link.covariance)
        motion = gtsam.Pose2(link.a_from_b.x, link.a_from_b.y, link.a_from_b.theta)
        graph.add(gtsam.BetweenFactorPose2(link.a, link.b, motion, noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, result)
    poses, covariances = {}, {}
    for index in initial:
        solved = result.atPose2(index)
        poses[index] = Pose2(solved.x(), solved.y(), solved.theta())
        covariances[index] = np.asarray(marginals.marginalCovariance(index), dtype=np.float64)
    return Solution(poses, covariances)


def compose_covariance(
    covariance_a: NDArray[np.float64], a_from_b: Pose2, covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance of ``map_from_b`` from that of ``map_from_a`` and of ``a_from_b``.

    Each in the axes of its right-hand frame; the first is carried over by the adjoint of
    ``b_from_a`` (Sola, Deray and Atchuthan, A micro Lie theory, 2018, eq. 56).
    """
    inverse = a_from_b.inverse()
    adjoint = inverse.matrix
    adjoint[0, 2], adjoint[1, 2] = inverse.y, -inverse.x
    carried: NDArray[np.float64] = adjoint @ covariance_a @ adjoint.T + covariance
    return carried
