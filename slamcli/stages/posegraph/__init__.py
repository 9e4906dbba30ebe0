"""All that was measured, weighed against one another: the poses that fit it best, and how surely.

A pose graph over SE(2): motions between frames, with headings of a compass and places of GPS, the
former's offset and the latter's frame and lever arm among the unknowns. Loops and the other sensors
are suspects, and so are steps that contradict their neighbours: graduated non-convexity switches
off those that the rest contradicts; how well the rest agrees tells how far to trust what links say
of their errors. Links alone are solved by GTSAM (Dellaert and Kaess, Factor Graphs for Robot
Perception, 2017) where it is installed, all else by scipy.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from types import ModuleType
from typing import Literal

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, Int64Array
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Link
from slamcli.stages.posegraph import gtsam_solver, sparse_solver
from slamcli.stages.posegraph.build import build, first_state
from slamcli.stages.posegraph.components import Sets, components, spanning
from slamcli.stages.posegraph.factors import (
    HeadingReading,
    PositionReading,
    SensorOffsets,
    Solution,
)
from slamcli.stages.posegraph.marginals import diagonal_blocks
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.state import GraphState
from slamcli.stages.posegraph.variance import variance_factor

Solver = Literal["gtsam", "scipy"]

__all__ = [
    "HeadingReading",
    "PositionReading",
    "SensorOffsets",
    "Solution",
    "components",
    "compose_covariance",
    "fuse",
    "solve",
    "spanning",
]

_TRUSTED = ("step", "odometry")
# Links that two pictures tell in all directions.
_SEEN = ("step", "loop")
_FUSE_STEPS = 4
# With so few outliers among the readings, none can pull the rest far.
_NEARLY_ALL = 0.9
_MAX_ROUNDS = 5


def solve(
    initial: Mapping[int, Pose2],
    links: Sequence[Link],
    headings: Sequence[HeadingReading] = (),
    places: Sequence[PositionReading] = (),
    *,
    lever_arm_metres: tuple[float, float] | None = (0.0, 0.0),
    held: Collection[int] = (),
    prior: SensorOffsets | None = None,
    solver: Solver | None = None,
) -> Solution:
    """Solve one connected component, its first frame held where it is.

    Parameters
    ----------
    initial : mapping of frame index to ``map_from_robot``
    links : sequence of Link
        Only between frames of `initial`. Steps and odometry are believed while they agree with
        one another; loops must convince.
    headings, places : sequences
        Only of frames of `initial`.
    lever_arm_metres : (float, float) or None
        Of the GPS antenna; None estimates it.
    held : collection of int
        Frames held where they are in place of the first one; covariances are as if they were known.
    prior : SensorOffsets or None
        What readings besides the given ones told of them; of the antenna this is taken for certain.
    solver : str or None
        None takes GTSAM where it is installed; for headings and places always scipy.
    """
    frames = sorted(initial)
    problem = build(
        frames,
        links,
        headings,
        places,
        lever_arm_metres=lever_arm_metres,
        held=held,
        prior=prior,
    )
    first = first_state(problem, pose_array([initial[frame] for frame in frames]))
    chosen = solver or ("gtsam" if find_spec("gtsam") else "scipy")
    links_alone = not headings and not places
    module = gtsam_solver if chosen == "gtsam" and links_alone else sparse_solver
    trusted = np.zeros(len(problem), np.bool_)
    trusted[: len(links)] = [link.kind in _TRUSTED for link in links]
    state, kept = _agreed(problem, first, trusted, module)
    seen = [n for n, link in enumerate(links) if link.kind in _SEEN and kept[n]]
    loops = sum(links[n].kind == "loop" for n in seen)
    weights = kept.astype(np.float64)
    factor = _factor(problem, state, np.array(seen, np.int64), loops)
    weights[seen] /= factor
    return _solution(problem, state, kept, frames, weights, factor)


def _agreed(
    problem: Problem, state: GraphState, trusted: BoolArray, solver: ModuleType
) -> tuple[GraphState, BoolArray]:
    """Return the solution of all factors that the others do not contradict, and which these are."""
    everything = np.ones(len(problem))
    whole = solver.optimise(problem, state, everything)
    if (problem.squared_errors(whole) <= sparse_solver.THRESHOLD).all():
        return whole, np.ones(len(problem), np.bool_)
    motions = len(problem.motions)
    # A step is above suspicion while it agrees with its neighbours, without any loop.
    chain, _ = _spanning(problem, len(state.poses), np.flatnonzero(trusted[:motions]))
    anchors = set(problem.anchors.tolist())
    free = [group[0] for group in chain.groups() if anchors.isdisjoint(group)]
    roots = np.array(sorted([*anchors, *free]))
    alone = solver.optimise(replace(problem, anchors=roots), state, trusted.astype(np.float64))
    steady = trusted & (problem.squared_errors(alone) <= sparse_solver.THRESHOLD)
    alone = first_state(problem, alone.poses)
    if steady[:motions].all() and (near := _nearly_agreed(problem, alone, solver)) is not None:
        return near
    order = np.argsort(~steady[:motions] + 1 * ~trusted[:motions], kind="stable")
    held = np.zeros(len(problem), np.bool_)
    held[_spanning(problem, len(state.poses), order)[1]] = True
    kept = solver.robust(problem, alone, ~steady, held & ~steady)
    return _settled(problem, alone, kept, solver)


def _nearly_agreed(
    problem: Problem, state: GraphState, solver: ModuleType
) -> tuple[GraphState, BoolArray] | None:
    """Return the solution where all links and most readings agree from the start, else None.

    Then what is not believed can be told by its error alone, round by round, in a fraction of the
    time.
    """
    kept = problem.squared_errors(state) <= sparse_solver.THRESHOLD
    for _ in range(_MAX_ROUNDS):
        kept[: len(problem.motions)] = True
        if kept.mean() < _NEARLY_ALL:
            return None
        state = solver.optimise(problem, state, kept.astype(np.float64))
        before, kept = kept, problem.squared_errors(state) <= sparse_solver.THRESHOLD
        if np.array_equal(before, kept):
            return state, kept
    return None


def _settled(
    problem: Problem, state: GraphState, kept: BoolArray, solver: ModuleType
) -> tuple[GraphState, BoolArray]:
    """Solve what was kept; then keep also what agrees with that, and what alone ties two parts."""
    motions = len(problem.motions)
    for last in (False, True):
        errors = problem.squared_errors(state)[:motions]
        order = np.argsort(np.where(kept[:motions], -1.0, errors), kind="stable")
        kept = kept.copy()
        kept[_spanning(problem, len(state.poses), order)[1]] = True
        state = solver.optimise(problem, state, kept.astype(np.float64))
        agrees = problem.squared_errors(state) <= sparse_solver.THRESHOLD
        if last or not (agrees & ~kept).any():
            break
        kept |= agrees
    return state, kept


def _spanning(problem: Problem, count: int, order: Int64Array) -> tuple[Sets, list[int]]:
    """Return what motions tie together, and the first ones in an order that do (Kruskal, 1956).

    What is held needs no motion between it.
    """
    sets = Sets(range(count))
    for anchor in problem.anchors.tolist():
        sets.merge(int(problem.anchors[0]), anchor)
    ends = zip(
        order.tolist(),
        problem.motions.a[order].tolist(),
        problem.motions.b[order].tolist(),
        strict=True,
    )
    return sets, [motion for motion, a, b in ends if sets.merge(a, b)]


def _factor(problem: Problem, state: GraphState, seen: Int64Array, loops: int) -> float:
    """Return the variance factor of links (by their numbers) that pictures tell of."""
    _, tree = _spanning(problem, len(state.poses), seen)
    errors = problem.squared_errors(state)[seen]
    return variance_factor(errors, len(seen) - len(tree), loops)


def _solution(
    problem: Problem,
    state: GraphState,
    kept: BoolArray,
    frames: Sequence[int],
    weights: Float64Array,
    factor: float,
) -> Solution:
    """Return the solution, its covariances by factors of such weights."""
    count = len(frames)
    equations = problem.linearise(state, weights)
    sizes = np.array([3] * count + [1, 3, 2])
    *blocks, compass, datum, _lever = diagonal_blocks(*equations.entries, sizes)
    off = np.flatnonzero(~kept)
    first = len(problem.motions)
    second = first + len(problem.headings)
    turn = Pose2(0.0, 0.0, float(state.east_north_from_map[2])).matrix
    return Solution(
        {frame: Pose2(*pose) for frame, pose in zip(frames, state.poses.tolist(), strict=True)},
        dict(zip(frames, blocks, strict=True)),
        tuple(off[off < first].tolist()),
        tuple((off[(off >= first) & (off < second)] - first).tolist()),
        tuple((off[off >= second] - second).tolist()),
        SensorOffsets(
            state.compass_offset,
            float(np.sqrt(compass[0, 0])),
            Pose2(*state.east_north_from_map.tolist()),
            turn @ datum @ turn.T,
            (float(state.lever_arm[0]), float(state.lever_arm[1])),
        ),
        factor,
    )


def fuse(first: Link, second: Link) -> Link:
    """Return what two links between the same frames say together, as the first one's kind.

    Least squares of both errors (Gauss-Newton): each says the more in a direction the surer it is.
    """
    pose = first.a_from_b
    information = np.zeros((3, 3))
    for _ in range(_FUSE_STEPS):
        information, pull = np.zeros((3, 3)), np.zeros(3)
        for link in (first, second):
            off = link.a_from_b.inverse() @ pose
            turned = Pose2(0.0, 0.0, off.theta).matrix
            weighted = turned.T @ np.linalg.inv(link.covariance)
            information += weighted @ turned
            pull += weighted @ np.array([off.x, off.y, off.theta])
        step = -np.linalg.solve(information, pull)
        pose = pose @ Pose2(float(step[0]), float(step[1]), float(step[2]))
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return replace(first, a_from_b=pose, covariance=covariance)


def compose_covariance(
    covariance_a: Float64Array, a_from_b: Pose2, covariance: Float64Array
) -> Float64Array:
    """Return the covariance of ``map_from_b`` from that of ``map_from_a`` and of ``a_from_b``.

    Each in the axes of its right-hand frame; the first is carried over by the adjoint of
    ``b_from_a`` (Sola, Deray and Atchuthan, A micro Lie theory, 2018, eq. 56).
    """
    inverse = a_from_b.inverse()
    adjoint = inverse.matrix
    adjoint[0, 2], adjoint[1, 2] = inverse.y, -inverse.x
    carried: Float64Array = adjoint @ covariance_a @ adjoint.T + covariance
    return carried
