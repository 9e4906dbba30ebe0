"""Pose-graph optimisation over SE(2), robust to outliers, with marginal covariances.

The factors are motions between frames, compass headings and GPS positions; the compass offset, the
GPS frame and the antenna's lever arm are variables beside the poses. Factors that all others
contradict are switched off (`outliers`), and the links' covariances are scaled by how well the
links agree (`variance`). After Dellaert and Kaess, Factor Graphs for Robot Perception, 2017.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Link
from slamcli.stages.posegraph.build import build, initial_state
from slamcli.stages.posegraph.components import components, spanning
from slamcli.stages.posegraph.composition import compose_covariance, fuse
from slamcli.stages.posegraph.factors import (
    HeadingReading,
    PositionReading,
    SensorOffsets,
    SensorReadings,
    Solution,
)
from slamcli.stages.posegraph.marginals import diagonal_blocks
from slamcli.stages.posegraph.outliers import solve_without_outliers, spanning_tree
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.sensitivity import pose_sensitivities
from slamcli.stages.posegraph.state import GraphState
from slamcli.stages.posegraph.variance import variance_factor

__all__ = [
    "HeadingReading",
    "PositionReading",
    "SensorOffsets",
    "SensorReadings",
    "Solution",
    "components",
    "compose_covariance",
    "fuse",
    "pose_sensitivities",
    "solve",
    "spanning",
]

_TRUSTED = ("step", "odometry")
# Links that two pictures determine in all directions.
_BY_PICTURE = ("step", "loop")
_NO_READINGS = SensorReadings()


def solve(
    initial: Mapping[int, Pose2],
    links: Sequence[Link],
    readings: SensorReadings = _NO_READINGS,
    *,
    fixed: Collection[int] = (),
) -> Solution:
    """Solve one connected component, its first frame fixed.

    Parameters
    ----------
    initial : mapping of frame index to ``map_from_robot``
    links : sequence of Link
        Only between frames of `initial`. Steps and odometry are trusted while they agree with one
        another; loops must agree with these.
    readings : SensorReadings
        Only of frames of `initial`.
    fixed : collection of int
        Fixed frames in place of the first one; covariances are conditional on them.
    """
    frames = sorted(initial)
    problem = build(frames, links, readings, fixed)
    first = initial_state(problem, pose_array([initial[frame] for frame in frames]))
    trusted = np.zeros(len(problem), np.bool_)
    trusted[: len(links)] = [link.kind in _TRUSTED for link in links]
    state, kept = solve_without_outliers(problem, first, trusted)
    seen = [n for n, link in enumerate(links) if link.kind in _BY_PICTURE and kept[n]]
    loops = sum(links[n].kind == "loop" for n in seen)
    weights = kept.astype(np.float64)
    factor = _factor(problem, state, np.array(seen, np.int64), loops)
    weights[seen] /= factor
    covariances, offsets = _marginals(problem, state, weights)
    outliers = np.split(~kept, [len(problem.motions), len(problem.motions) + len(problem.headings)])
    switched_off, headings, positions = (tuple(np.flatnonzero(o).tolist()) for o in outliers)
    return Solution(
        {frame: Pose2(*pose) for frame, pose in zip(frames, state.poses.tolist(), strict=True)},
        dict(zip(frames, covariances, strict=True)),
        switched_off,
        headings,
        positions,
        offsets,
        factor,
    )


def _factor(problem: Problem, state: GraphState, seen: Int64Array, loops: int) -> float:
    """Return the variance factor of the links, given by index, that pictures determine."""
    _, tree = spanning_tree(problem, len(state.poses), seen)
    errors = problem.squared_errors(state)[seen]
    return variance_factor(errors, len(seen) - len(tree), loops)


def _marginals(
    problem: Problem, state: GraphState, weights: Float64Array
) -> tuple[list[Float64Array], SensorOffsets]:
    """Return the poses' marginal covariances and the sensor offsets, by weighted factors."""
    equations = problem.linearize(state, weights)
    sizes = np.array([3] * len(state.poses) + [1, 3, 2])
    *blocks, compass, datum, _lever = diagonal_blocks(*equations.entries, sizes)
    turn = Pose2(0.0, 0.0, float(state.east_north_from_map[2])).matrix
    return blocks, SensorOffsets(
        state.compass_offset,
        float(np.sqrt(compass[0, 0])),
        Pose2(*state.east_north_from_map.tolist()),
        turn @ datum @ turn.T,
        (float(state.lever_arm[0]), float(state.lever_arm[1])),
    )
