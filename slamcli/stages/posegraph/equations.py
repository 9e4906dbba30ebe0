"""Normal equations of a pose graph, assembled factor by factor."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array


class Equations:
    """Sparse ``H step = -gradient``, as sums over factors."""

    def __init__(self, size: int) -> None:
        self.gradient = np.zeros(size)
        self._rows: list[Int64Array] = []
        self._columns: list[Int64Array] = []
        self._values: list[Float64Array] = []

    @property
    def entries(self) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Rows, columns and values of H, (E,) each; entries of equal row and column add up."""
        return (
            np.concatenate(self._rows),
            np.concatenate(self._columns),
            np.concatenate(self._values),
        )

    def add(
        self,
        variables: Sequence[Int64Array],
        jacobians: Sequence[Float64Array],
        residuals: Float64Array,
    ) -> None:
        """Add K factors over the same kinds of variables.

        Parameters
        ----------
        variables : sequence of (K, d) int64
            Indices in the step.
        jacobians : sequence of (K, r, d) float64
            Whitened.
        residuals : (K, r) float64
            Whitened.
        """
        for one, jacobian in zip(variables, jacobians, strict=True):
            np.add.at(self.gradient, one, np.einsum("krd,kr->kd", jacobian, residuals))
            for other, second in zip(variables, jacobians, strict=True):
                block = np.swapaxes(jacobian, 1, 2) @ second
                shape = block.shape
                self._rows.append(np.broadcast_to(one[:, :, None], shape).ravel())
                self._columns.append(np.broadcast_to(other[:, None, :], shape).ravel())
                self._values.append(block.ravel())
