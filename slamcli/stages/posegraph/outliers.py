"""Robust solution: finds the factors that all others contradict and solves without them.

Steps and odometry are trusted while they agree with one another; loops and sensor readings are
suspects from the start. Graduated non-convexity (`sparse_solver.robust`) decides about these, only
where a plain solution has outliers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.cluster.hierarchy import DisjointSet

from slamcli.core.arrays import BoolArray, Int64Array
from slamcli.stages.posegraph import sparse_solver
from slamcli.stages.posegraph.build import initial_state
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.state import GraphState

# With a larger share of inliers among the factors, the outliers cannot move the solution far, and
# their errors alone identify them. [guarded by tests/mapping/backend/test_sensors.py]
_MIN_INLIER_SHARE = 0.9
_MAX_ROUNDS = 5


def solve_without_outliers(
    problem: Problem, state: GraphState, trusted: BoolArray
) -> tuple[GraphState, BoolArray]:
    """Return the solution of all factors that the others do not contradict, and which these are.

    Parameters
    ----------
    problem : Problem
    state : GraphState
        Initial.
    trusted : (F,) bool
        Steps and odometry.
    """
    whole = sparse_solver.optimize(problem, state, np.ones(len(problem)))
    if _inliers(problem, whole).all():
        return whole, np.ones(len(problem), np.bool_)
    motions = len(problem.motions)
    alone = _solve_trusted(problem, state, trusted)
    # A step stays trusted while it agrees with its neighbours, without any loop.
    consistent = trusted & _inliers(problem, alone)
    alone = initial_state(problem, alone.poses)
    if consistent[:motions].all() and (near := _reject_by_error(problem, alone)) is not None:
        return near
    order = np.argsort(~consistent[:motions] + 1 * ~trusted[:motions], kind="stable")
    needed = np.zeros(len(problem), np.bool_)
    needed[spanning_tree(problem, len(state.poses), order)[1]] = True
    kept = sparse_solver.robust(problem, alone, ~consistent, needed & ~consistent)
    return _readmit(problem, alone, kept)


def spanning_tree(problem: Problem, count: int, order: Int64Array) -> tuple[DisjointSet, list[int]]:
    """Return the components of motions, and the first motions in an order that connect them.

    Fixed poses count as connected. (Kruskal, 1956)
    """
    sets = DisjointSet(range(count))
    for anchor in problem.anchors.tolist():
        sets.merge(int(problem.anchors[0]), anchor)
    ends = zip(
        order.tolist(),
        problem.motions.a[order].tolist(),
        problem.motions.b[order].tolist(),
        strict=True,
    )
    return sets, [motion for motion, a, b in ends if sets.merge(a, b)]


def _inliers(problem: Problem, state: GraphState) -> BoolArray:
    return np.asarray(problem.squared_errors(state) <= sparse_solver.MAX_INLIER_SQUARED_ERROR)


def _solve_trusted(problem: Problem, state: GraphState, trusted: BoolArray) -> GraphState:
    """Return the solution of trusted factors alone, one pose of each of their components fixed."""
    motions = len(problem.motions)
    chain, _ = spanning_tree(problem, len(state.poses), np.flatnonzero(trusted[:motions]))
    anchors = set(problem.anchors.tolist())
    free = [min(subset) for subset in chain.subsets() if anchors.isdisjoint(subset)]
    roots = np.array(sorted([*anchors, *free]))
    problem = replace(problem, anchors=roots)
    return sparse_solver.optimize(problem, state, trusted.astype(np.float64))


def _reject_by_error(problem: Problem, state: GraphState) -> tuple[GraphState, BoolArray] | None:
    """Return the solution where all links and most readings agree from the start, else None.

    Readings are rejected by their errors alone, round by round: a fraction of the time of
    graduated non-convexity.
    """
    kept = _inliers(problem, state)
    for _ in range(_MAX_ROUNDS):
        kept[: len(problem.motions)] = True
        if kept.mean() < _MIN_INLIER_SHARE:
            return None
        state = sparse_solver.optimize(problem, state, kept.astype(np.float64))
        before, kept = kept, _inliers(problem, state)
        if np.array_equal(before, kept):
            return state, kept
    return None


def _readmit(problem: Problem, state: GraphState, kept: BoolArray) -> tuple[GraphState, BoolArray]:
    """Solve the kept factors; add those that agree, and motions that alone connect components."""
    motions = len(problem.motions)
    for last in (False, True):
        errors = problem.squared_errors(state)[:motions]
        order = np.argsort(np.where(kept[:motions], -1.0, errors), kind="stable")
        kept = kept.copy()
        kept[spanning_tree(problem, len(state.poses), order)[1]] = True
        state = sparse_solver.optimize(problem, state, kept.astype(np.float64))
        agrees = _inliers(problem, state)
        if last or not (agrees & ~kept).any():
            break
        kept |= agrees
    return state, kept
