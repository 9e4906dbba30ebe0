"""Sparse Levenberg-Marquardt, and graduated non-convexity for outliers, with scipy.

Yang, Antonante, Tzoumas and Carlone, Graduated Non-Convexity for Robust Spatial Perception, RA-L
2020: truncated least squares, approached from a convex surrogate. In the surrogate every factor
has a weight; as it tightens, the weights of those that the others contradict go to zero.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.special import chdtri

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.stages.posegraph.problem import Problem
from slamcli.stages.posegraph.state import GraphState

# The squared error of an inlier is above the threshold once in ten thousand; of an outlier, mostly
# far above. One threshold for all factors, that of three dimensions.
INLIER_PROBABILITY = 0.9999
MAX_INLIER_SQUARED_ERROR = float(chdtri(3, 1.0 - INLIER_PROBABILITY))
_MAX_STEPS = 50
_MIN_GAIN = 1e-10
_FIRST_DAMPING = 1e-6
_MAX_DAMPING = 1e12
# The surrogate tightens by this factor (the paper's), faster where it is still loose (GTSAM's
# super-linear schedule). Each solution starts from the initial state with a few steps: started from
# the one before, which the outliers have bent, it switches off true loops.
# [tests/stages/test_posegraph.py, false loops across a long drive: 16 of 16, else 118 to 135]
_TIGHTENING = 1.4
_STEPS_A_TIGHTENING = 2
_MAX_TIGHTENINGS = 100
# A smaller share of the largest weight is zero: such a factor is left out of the equations. It is a
# share, as an error of a kilometre makes all weights of the first rounds that small
# [guarded by tests/mapping/backend/test_sensors.py].
MIN_WEIGHT = 1e-6
_NEARLY_DECIDED = 1e-3


def optimize(
    problem: Problem, state: GraphState, weights: Float64Array, max_steps: int = _MAX_STEPS
) -> GraphState:
    """Return the state of least weighted squares near an initial one (Levenberg-Marquardt).

    Equations that rounding makes singular, as measurements of metres beside a jump of a thousand
    kilometres do, are solved with damping; where no step helps, the state is returned as it is.
    """
    cost, damping = problem.cost(state, weights), 0.0
    for _ in range(max_steps):
        equations = problem.linearize(state, weights)
        rows, columns, values = equations.entries
        size = len(equations.gradient)
        hessian = sparse.csc_matrix((values, (rows, columns)), shape=(size, size))
        while True:
            step = _solved(hessian, -equations.gradient, damping)
            after = None if step is None else state.plus(step)
            least = math.inf if after is None else problem.cost(after, weights)
            if after is not None and least <= cost * (1.0 + _MIN_GAIN):
                break
            if damping > _MAX_DAMPING:
                return state
            damping = max(_FIRST_DAMPING, 10.0 * damping)
        gain, cost, state = cost - least, least, after
        damping = 0.0 if damping <= _FIRST_DAMPING else 0.1 * damping
        if gain <= _MIN_GAIN * cost:
            break
    return state


def robust(
    problem: Problem,
    state: GraphState,
    suspects: BoolArray,
    needed: BoolArray,
) -> BoolArray:
    """Return which factors to keep: all but the suspects that the others contradict.

    Parameters
    ----------
    problem : Problem
    state : GraphState
        Initial.
    suspects : (F,) bool
        Factors that may be outliers.
    needed : (F,) bool
        Suspects that alone connect parts of the graph; their weight stays above zero.
    """
    weights = np.ones(len(problem))
    solved = optimize(problem, state, weights, _STEPS_A_TIGHTENING)
    ratio = problem.squared_errors(solved)[suspects] / MAX_INLIER_SQUARED_ERROR
    if not ratio.size or ratio.max() <= 1.0:
        return np.ones(len(problem), np.bool_)
    control = 1.0 / (2.0 * float(ratio.max()) - 1.0)
    for _ in range(_MAX_TIGHTENINGS):
        ratio = problem.squared_errors(solved)[suspects] / MAX_INLIER_SQUARED_ERROR
        decided = _weights(ratio, control)
        weights[suspects] = decided
        weights[needed] = np.maximum(weights[needed], MIN_WEIGHT)
        solved = optimize(problem, state, weights, _STEPS_A_TIGHTENING)
        if np.all(np.minimum(decided, 1.0 - decided) < _NEARLY_DECIDED) and control > 1.0:
            break
        fast = min(math.sqrt(control), _fastest(problem, solved, suspects))
        control = max(fast, _TIGHTENING * control)
    kept: BoolArray = ~suspects | (weights > 0.5)
    return kept


def _fastest(problem: Problem, state: GraphState, suspects: BoolArray) -> float:
    """Return the control at which half of the compass's, or of the GPS's, readings lose all weight.

    The readings of one sensor have offsets in common, which outliers move for all of them: a faster
    schedule would reject the good ones before the offsets have come back.
    """
    ratios = problem.squared_errors(state) / MAX_INLIER_SQUARED_ERROR
    ends = np.cumsum([len(problem.motions), len(problem.headings)])
    _, *readings = np.split(np.where(suspects, ratios, np.nan), ends)
    medians = [float(np.nanmedian(r)) for r in readings if not np.isnan(r).all()]
    return 1.0 / max([*medians, 1e-12])


def _weights(ratio: Float64Array, control: float) -> Float64Array:
    """Return the weights of squared errors relative to their threshold (eq. 14 of the paper)."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(control * (control + 1.0) / ratio) - control
    weights = np.clip(np.where(ratio <= control / (control + 1.0), 1.0, between), 0.0, 1.0)
    return np.where(weights < MIN_WEIGHT * weights.max(), 0.0, weights)


def _solved(
    hessian: sparse.csc_matrix, gradient: Float64Array, damping: float
) -> Float64Array | None:
    """Return the damped step; None where rounding leaves none."""
    if damping > 0.0:
        hessian = (hessian + sparse.diags_array(damping * hessian.diagonal())).tocsc()
    try:
        factor = splu(
            hessian,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError:  # SuperLU's only sign of a singular matrix
        return None
    step: Float64Array = factor.solve(gradient)
    return step if np.isfinite(step).all() else None
