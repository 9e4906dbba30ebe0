"""The pose graph of links alone solved with GTSAM: the oracle for `posegraph.sparse_solver`.

GTSAM's Python has no factor for a heading or a position whose frame is unknown.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.sparse_solver import INLIER_PROBABILITY, MIN_WEIGHT
from slamcli.stages.posegraph.state import ANCHOR_SIGMA, GraphState

_RELATIVE_ERROR = 1e-10
# GTSAM starts each of them from the initial state.
_STEPS_A_TIGHTENING = 2


def optimize(problem: Problem, state: GraphState, weights: Float64Array) -> GraphState:
    """Return the state of least squares of the factors with weight 1 near an initial one."""
    graph = _fixed(problem, state)
    for factor in np.flatnonzero(weights).tolist():
        graph.add(_factor(problem, factor))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(_RELATIVE_ERROR)
    values = _values(state)
    return _state(state, gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize())


def robust(
    problem: Problem, state: GraphState, suspects: BoolArray, needed: BoolArray
) -> BoolArray:
    """Return which factors to keep, as `sparse_solver.robust`."""
    graph = _fixed(problem, state)
    for factor in np.flatnonzero(needed).tolist():
        graph.add(_factor(problem, factor, MIN_WEIGHT))
    for factor in np.flatnonzero(~suspects).tolist():
        graph.add(_factor(problem, factor))
    known = graph.size()
    for factor in np.flatnonzero(suspects).tolist():
        graph.add(_factor(problem, factor))
    inner = gtsam.LevenbergMarquardtParams()
    inner.setMaxIterations(_STEPS_A_TIGHTENING)
    parameters = gtsam.GncLMParams(inner)
    parameters.setScheduler(gtsam.GncScheduler.SuperLinear)
    parameters.setKnownInliers(list(range(known)))
    optimiser = gtsam.GncLMOptimizer(graph, _values(state), parameters)
    optimiser.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
    optimiser.optimize()
    kept: BoolArray = ~suspects
    kept[suspects] = np.asarray(optimiser.getWeights())[known:] > 0.5
    return kept


def _fixed(problem: Problem, state: GraphState) -> Any:
    """Return a graph of the fixed poses."""
    graph = gtsam.NonlinearFactorGraph()
    firm = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
    for anchor in problem.anchors.tolist():
        graph.add(gtsam.PriorFactorPose2(anchor, gtsam.Pose2(*state.poses[anchor]), firm))
    return graph


def _factor(problem: Problem, number: int, weight: float = 1.0) -> Any:
    motions = problem.motions
    # GTSAM wants this root upper triangular, and takes a lower one's diagonal for all of it.
    root = np.linalg.qr(np.sqrt(weight) * motions.whitening[number], mode="r")
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
    motion = gtsam.Pose2(*motions.a_from_b[number])
    return gtsam.BetweenFactorPose2(motions.a[number], motions.b[number], motion, noise)


def _values(state: GraphState) -> Any:
    values = gtsam.Values()
    for key, pose in enumerate(state.poses.tolist()):
        values.insert(key, gtsam.Pose2(*pose))
    return values


def _state(state: GraphState, values: Any) -> GraphState:
    solved = [values.atPose2(key) for key in range(len(state.poses))]
    poses = np.array([(pose.x(), pose.y(), pose.theta()) for pose in solved])
    return GraphState(poses, state.offsets)
