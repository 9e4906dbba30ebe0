"""The least-squares problem: factors as arrays, their residuals and linearisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.stages.posegraph.equations import Equations
from slamcli.stages.posegraph.measurements import Factors, Headings, Motions, Positions, some_of
from slamcli.stages.posegraph.state import ANCHOR_SIGMA, LOOSE_SIGMA, GraphState, SensorPrior


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All factors, numbered from motions over headings to positions.

    Attributes
    ----------
    motions, headings, positions
    shares : (F,) float64
        Weight of each factor in (0, 1]: below 1 where errors are correlated.
    anchors : (A,) int64
        Indices of the fixed poses: at least one in each connected component.
    prior : SensorPrior
    """

    motions: Motions
    headings: Headings
    positions: Positions
    shares: Float64Array
    anchors: Int64Array
    prior: SensorPrior

    def __len__(self) -> int:
        return len(self.shares)

    @property
    def _kinds(self) -> tuple[Factors, ...]:
        return self.motions, self.headings, self.positions

    def squared_errors(self, state: GraphState) -> Float64Array:
        """Return (F,): every factor's squared residual, in its own variances."""
        return np.concatenate([np.sum(kind.errors(state) ** 2, axis=1) for kind in self._kinds])

    def cost(self, state: GraphState, weights: Float64Array) -> float:
        """Return the weighted sum of squared residuals, which a solution minimises."""
        prior = float(np.sum(self.prior.errors(state) ** 2))
        return float((weights * self.shares) @ self.squared_errors(state)) + prior

    def linearize(self, state: GraphState, weights: Float64Array) -> Equations:
        """Return the normal equations at a state; factors of weight 0 are left out of them.

        Parameters
        ----------
        state : GraphState
        weights : (F,) float64
        """
        count = len(state.poses)
        equations = Equations(3 * count + len(state.offsets))
        first, second = len(self.motions), len(self.motions) + len(self.headings)
        parts = np.split(weights * self.shares, [first, second])
        for kind, part in zip(self._kinds, parts, strict=True):
            _add(equations, kind, state, part)
        # A pose that has lost all its factors must not make the equations singular.
        anywhere = np.broadcast_to(np.eye(3) / LOOSE_SIGMA, (count, 3, 3))
        equations.add([np.arange(3 * count).reshape(-1, 3)], [anywhere], np.zeros((count, 3)))
        count_fixed = len(self.anchors)
        firm = np.broadcast_to(np.eye(3) / ANCHOR_SIGMA, (count_fixed, 3, 3))
        fixed = 3 * self.anchors[:, None] + np.arange(3)
        equations.add([fixed], [np.asarray(firm)], np.zeros((count_fixed, 3)))
        # Else fixed poses between others would move a little in each step, without convergence.
        equations.gradient[fixed] = 0.0
        offsets = (3 * count + np.arange(6))[None]
        residuals = self.prior.errors(state)
        equations.add([offsets], [self.prior.whitening[None]], residuals[None])
        return equations


def _add(
    equations: Equations,
    factors: Factors,
    state: GraphState,
    weights: Float64Array,
) -> None:
    used = np.flatnonzero(weights)
    root = np.sqrt(weights[used])
    some = some_of(factors, used)
    variables, jacobians = some.jacobians(state)
    weighted = [root[:, None, None] * jacobian for jacobian in jacobians]
    equations.add(variables, weighted, root[:, None] * some.errors(state))
