"""The pose graph solved with GTSAM, which is imported here and nowhere else.

GTSAM's Python has no factor for one heading or one place with an unknown frame, so both are motions
of which only a part is measured: from a compass's frame to the robot, and from the datum to the
antenna, which hangs on the robot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.stages.posegraph.problem import ANCHOR_SIGMA, State
from slamcli.stages.posegraph.sparse_solver import INLIER_PROBABILITY, LEAST_WEIGHT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.stages.posegraph.problem import Problem

# Of what is not measured (m, rad).
_ANY = 1e6
# The compass's frame has a heading alone; its place is held anywhere.
_COMPASS_SIGMAS = np.array([1.0, 1.0, 1e4])
_DATUM_SIGMAS = np.array([1e4, 1e4, 1e4])
_RELATIVE_ERROR = 1e-10
# The next tightening begins where the last one left.
_STEPS_A_TIGHTENING = 2


def optimise(problem: Problem, state: State, weights: NDArray[np.float64]) -> State:
    """Return the state of least squares of the factors with weight 1 near a first one."""
    import gtsam

    graph = _fixed(problem, state)
    for place in np.flatnonzero(weights).tolist():
        graph.add(_factor(problem, place))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(_RELATIVE_ERROR)
    values = _values(problem, state)
    return _state(state, gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize())


def robust(
    problem: Problem, state: State, suspects: NDArray[np.bool_], held: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which factors to keep: those under no suspicion, and the suspects that agree.

    Parameters
    ----------
    problem : Problem
    state : State
        A first one.
    suspects : (F,) bool
        Factors that may be false.
    held : (F,) bool
        Suspects without which the graph may fall apart; their weight never vanishes.
    """
    import gtsam

    graph = _fixed(problem, state)
    for place in np.flatnonzero(held).tolist():
        graph.add(_factor(problem, place, LEAST_WEIGHT))
    for place in np.flatnonzero(~suspects).tolist():
        graph.add(_factor(problem, place))
    known = graph.size()
    for place in np.flatnonzero(suspects).tolist():
        graph.add(_factor(problem, place))
    inner = gtsam.LevenbergMarquardtParams()
    inner.setMaxIterations(_STEPS_A_TIGHTENING)
    parameters = gtsam.GncLMParams(inner)
    parameters.setScheduler(gtsam.GncScheduler.SuperLinear)
    parameters.setKnownInliers(list(range(known)))
    optimiser = gtsam.GncLMOptimizer(graph, _values(problem, state), parameters)
    optimiser.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
    optimiser.optimize()
    kept: NDArray[np.bool_] = ~suspects
    kept[suspects] = np.asarray(optimiser.getWeights())[known:] > 0.5
    return kept


def _fixed(problem: Problem, state: State) -> Any:
    """Return a graph of what holds: the map's origin, the frames of the senses, the antennas."""
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    firm = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
    for anchor in problem.anchors.tolist():
        graph.add(gtsam.PriorFactorPose2(anchor, gtsam.Pose2(*state.poses[anchor]), firm))
    count = len(state.poses)
    compass, datum = _sense_frames(state)
    for key, pose, sigmas in (
        (count, compass, _COMPASS_SIGMAS),
        (count + 1, datum, _DATUM_SIGMAS),
    ):
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        graph.add(gtsam.PriorFactorPose2(key, _pose(pose), noise))
    for number, (robot, motion) in enumerate(_antennas(problem, state)):
        graph.add(gtsam.BetweenFactorPose2(robot, count + 2 + number, _pose(motion), firm))
    return graph


def _factor(problem: Problem, place: int, weight: float = 1.0) -> Any:
    import gtsam

    motions, headings, places = problem.motions, problem.headings, problem.places
    count = problem.pose_count
    if place < len(motions.a):
        root = np.sqrt(weight) * motions.whitening[place]
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
        motion = gtsam.Pose2(*motions.a_from_b[place])
        return gtsam.BetweenFactorPose2(motions.a[place], motions.b[place], motion, noise)
    place -= len(motions.a)
    if place < len(headings.pose):
        sigmas = np.array([_ANY, _ANY, headings.sigma[place]])
        motion = gtsam.Pose2(0.0, 0.0, headings.heading[place] - headings.turn[place])
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        return gtsam.BetweenFactorPose2(count, headings.pose[place], motion, noise)
    place -= len(headings.pose)
    sigmas = np.array([places.sigma[place], places.sigma[place], _ANY])
    east, north = places.east_north[place].tolist()
    motion = gtsam.Pose2(east, north, 0.0)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    return gtsam.BetweenFactorPose2(count + 1, count + 2 + place, motion, noise)


def _values(problem: Problem, state: State) -> Any:
    import gtsam

    values = gtsam.Values()
    for key, pose in enumerate(state.poses.tolist()):
        values.insert(key, gtsam.Pose2(*pose))
    for key, pose in enumerate(_sense_frames(state), start=len(state.poses)):
        values.insert(key, _pose(pose))
    for number, (place, motion) in enumerate(_antennas(problem, state)):
        antenna = Pose2(*state.poses[place]) @ motion
        values.insert(len(state.poses) + 2 + number, _pose(antenna))
    return values


def _state(state: State, values: Any) -> State:
    count = len(state.poses)
    solved = [values.atPose2(key) for key in range(count + 2)]
    poses = np.array([(pose.x(), pose.y(), pose.theta()) for pose in solved])
    datum = Pose2(*poses[count + 1].tolist()).inverse()
    senses = np.array([-poses[count, 2], datum.x, datum.y, datum.theta, *state.lever_arm])
    return State(poses[:count], senses)


def _sense_frames(state: State) -> tuple[Pose2, Pose2]:
    """Return ``map_from_compass`` and ``map_from_east_north``."""
    return Pose2(0.0, 0.0, -state.compass_offset), Pose2(*state.east_north_from_map).inverse()


def _antennas(problem: Problem, state: State) -> list[tuple[int, Pose2]]:
    """Return, for every place, its pose's number and ``pose_from_antenna``."""
    lever = Pose2(*state.lever_arm)
    return [
        (pose, Pose2(*motion) @ lever)
        for pose, motion in zip(
            problem.places.pose.tolist(), problem.places.motion.tolist(), strict=True
        )
    ]


def _pose(pose: Pose2) -> Any:
    import gtsam

    return gtsam.Pose2(pose.x, pose.y, pose.theta)
