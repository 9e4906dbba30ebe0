"""A pose graph as arrays: all that was measured, and how it misses what is sought."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.stages.posegraph.equations import Equations
from slamcli.stages.posegraph.measurements import Headings, Measured, Motions, Places, some_of
from slamcli.stages.posegraph.state import ANCHOR_SIGMA, LOOSE_SIGMA, GraphState, SensorPrior


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All factors, numbered on from motions over headings to places.

    Attributes
    ----------
    motions, headings, places
    shares : (F,) float64
        What each factor counts beside one that errs independently of all others.
    anchors : (A,) int64
        Places of the poses that are held: at least one for all that hangs together.
    prior : SensorPrior
    """

    motions: Motions
    headings: Headings
    places: Places
    shares: Float64Array
    anchors: Int64Array
    prior: SensorPrior

    def __len__(self) -> int:
        return len(self.shares)

    @property
    def _kinds(self) -> tuple[Measured, ...]:
        return self.motions, self.headings, self.places

    def squared_errors(self, state: GraphState) -> Float64Array:
        """Return (F,): every factor's squared residual, in its own variances."""
        return np.concatenate([np.sum(kind.errors(state) ** 2, axis=1) for kind in self._kinds])

    def cost(self, state: GraphState, weights: Float64Array) -> float:
        """Return the weighted sum of squares that a solution makes least."""
        known = float(np.sum(self.prior.errors(state) ** 2))
        return float((weights * self.shares) @ self.squared_errors(state)) + known

    def linearise(self, state: GraphState, weights: Float64Array) -> Equations:
        """Return the normal equations at a state, each factor weighted; those at 0 leave no trace.

        Parameters
        ----------
        state : GraphState
        weights : (F,) float64
        """
        count = len(state.poses)
        equations = Equations(3 * count + len(state.senses))
        first, second = len(self.motions), len(self.motions) + len(self.headings)
        parts = np.split(weights * self.shares, [first, second])
        for kind, part in zip(self._kinds, parts, strict=True):
            _add(equations, kind, state, part)
        # What has lost all that tied it must not make the equations singular.
        anywhere = np.broadcast_to(np.eye(3) / LOOSE_SIGMA, (count, 3, 3))
        equations.add([np.arange(3 * count).reshape(-1, 3)], [anywhere], np.zeros((count, 3)))
        held = len(self.anchors)
        firm = np.broadcast_to(np.eye(3) / ANCHOR_SIGMA, (held, 3, 3))
        fixed = 3 * self.anchors[:, None] + np.arange(3)
        equations.add([fixed], [np.asarray(firm)], np.zeros((held, 3)))
        # Else what is held between others would creep, a little each step, and none be the last.
        equations.gradient[fixed] = 0.0
        senses = (3 * count + np.arange(6))[None]
        slopes, residuals = self.prior.whitening, self.prior.errors(state)
        equations.add([senses], [slopes[None]], residuals[None])
        return equations


def _add(
    equations: Equations,
    measured: Measured,
    state: GraphState,
    weights: Float64Array,
) -> None:
    used = np.flatnonzero(weights)
    root = np.sqrt(weights[used])
    some = some_of(measured, used)
    variables, jacobians = some.slopes(state)
    weighted = [root[:, None, None] * jacobian for jacobian in jacobians]
    equations.add(variables, weighted, root[:, None] * some.errors(state))
