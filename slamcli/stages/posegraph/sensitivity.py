"""Sensitivity of solved poses to errors that all links have in common ("consider" parameters).

The error of a calibration is in every link and shown by none of their differences: the solution
moves with it as a whole. It is not estimated, and its covariance is carried over to the poses by
their derivatives (Schmidt, Application of state-space methods to navigation problems, 1966).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Link
from slamcli.stages.posegraph.build import build, initial_state
from slamcli.stages.posegraph.factors import SensorReadings
from slamcli.stages.posegraph.state import GraphState


def pose_sensitivities(
    poses: Mapping[int, Pose2],
    links: Sequence[Link],
    readings: SensorReadings,
    by_link: Float64Array,
) -> dict[int, Float64Array]:
    """Return how a component's solved poses move with parameters that its links depend on.

    Parameters
    ----------
    poses : mapping of frame index to ``map_from_robot``
        The solution; its first frame stays where it is.
    links : sequence of Link
        Those that were kept.
    readings : SensorReadings
    by_link : (L, 3, K) float64
        Derivatives of each link's motion, in b's own axes, by the parameters.

    Returns
    -------
    dict of int to (3, K) float64
        In the robot's own axes.
    """
    frames = sorted(poses)
    problem = build(frames, links, readings)
    state: GraphState = initial_state(problem, pose_array([poses[frame] for frame in frames]))
    equations = problem.linearize(state, np.ones(len(problem)))
    rows, columns, values = equations.entries
    size = len(equations.gradient)
    hessian = sparse.csc_matrix((values, (rows, columns)), shape=(size, size))
    right = np.zeros((size, by_link.shape[2]))
    whitened = problem.motions.whitening @ by_link
    for variables, jacobians in zip(*problem.motions.jacobians(state), strict=True):
        np.add.at(right, variables, np.swapaxes(jacobians, 1, 2) @ whitened)
    moved = splu(hessian, permc_spec="MMD_AT_PLUS_A").solve(right)
    return dict(zip(frames, moved[: 3 * len(frames)].reshape(len(frames), 3, -1), strict=True))
