"""Marginal covariances: the diagonal blocks of a large sparse inverse (selected inversion).

A multifrontal Cholesky factorisation and, back down its tree, the entries of the inverse that lie
where the factor has any (Takahashi, Fagan and Chin, 1973; Erisman and Tinney, On computing certain
elements of the inverse of a sparse matrix, 1975; Duff and Reid, The multifrontal solution of
indefinite sparse symmetric linear equations, 1983). The cost is a small multiple of one solution's.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.linalg import lapack
from scipy.sparse.linalg import splu

from slamcli.core.arrays import Float64Array, Int64Array

# Merged fronts may have this many blocks more than needed: fewer, larger steps are faster.
# [benchmarks/backend.py: 8 s for 10,000 poses, solution and covariances]
_MAX_PADDING_BLOCKS = 4
# Shares of its diagonal that are added to a matrix which rounding has made indefinite, in turn: a
# direction whose sigma is over ten million times that of its variable alone gets a smaller one.
# [guarded by tests/stages/test_posegraph_scale.py]
_REGULARIZATIONS = (0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6)


@dataclass(slots=True, eq=False)
class _Front:
    """A dense part of the factorisation: columns eliminated together, and the rows they touch.

    Blocks are numbered in the order of elimination.
    """

    columns: list[int]
    touched: list[int]
    children: list[int] = field(default_factory=list)
    parent: int = -1


def diagonal_blocks(
    rows: Int64Array,
    columns: Int64Array,
    values: Float64Array,
    sizes: Int64Array,
) -> list[Float64Array]:
    """Return the diagonal blocks of the inverse of a symmetric positive definite matrix.

    Parameters
    ----------
    rows, columns, values : (E,)
        The matrix's entries, both triangles; entries of equal row and column add up.
    sizes : (B,) int64
        Of its blocks, which lie on the diagonal without a gap.

    Raises
    ------
    numpy.linalg.LinAlgError
        When the matrix is not positive definite, by more than rounding.
    """
    starts = np.concatenate([[0], np.cumsum(sizes)])
    block_of = np.repeat(np.arange(len(sizes)), sizes)
    pattern = _pattern(block_of[rows], block_of[columns], len(sizes))
    order = _elimination_order(pattern)
    fronts = _merged(*_symbolic(pattern, order))
    # Scalars in the order of elimination.
    position_of = np.empty(len(sizes), np.int64)
    position_of[order] = np.arange(len(sizes))
    new_starts = np.concatenate([[0], np.cumsum(sizes[order])])
    moved = new_starts[position_of[block_of]] + np.arange(len(block_of)) - starts[block_of]
    spans = [np.arange(new_starts[k], new_starts[k + 1]) for k in range(len(sizes))]
    matrix = sparse.coo_array((values, (moved[rows], moved[columns])), shape=(starts[-1],) * 2)
    inverses = _regularized_inverses(sparse.tril(matrix, format="csc"), fronts, spans)
    blocks: list[Float64Array] = [np.empty(0)] * len(sizes)
    for front, (indices, inverse) in zip(fronts, inverses, strict=True):
        for column in front.columns:
            here = np.searchsorted(indices, spans[column])
            blocks[int(order[column])] = inverse[np.ix_(here, here)]
    return blocks


def _regularized_inverses(
    lower: sparse.csc_array, fronts: list[_Front], spans: list[Int64Array]
) -> list[tuple[Int64Array, Float64Array]]:
    """Return what `_invert` does, of the matrix or else of one that is slightly more definite."""
    for share in _REGULARIZATIONS:
        added = sparse.diags_array(share * lower.diagonal(), format="csc")
        with contextlib.suppress(np.linalg.LinAlgError):
            return _invert(_Matrix(lower if share == 0.0 else lower + added), fronts, spans)
    raise np.linalg.LinAlgError("the map's equations are singular")


class _Matrix:
    """Columns of the lower triangle, for repeated access."""

    def __init__(self, lower: sparse.csc_array) -> None:
        self._starts, self._rows, self._values = lower.indptr, lower.indices, lower.data

    def put(self, front: Float64Array, indices: Int64Array, count: int) -> None:
        """Write the first `count` columns of a front, of the scalars `indices`, into it."""
        begin, end = self._starts[indices[0]], self._starts[indices[0] + count]
        widths = np.diff(self._starts[indices[0] : indices[0] + count + 1])
        rows = np.searchsorted(indices, self._rows[begin:end])
        columns = np.repeat(np.arange(count), widths)
        front[rows, columns] = self._values[begin:end]
        front[columns, rows] = self._values[begin:end]


def _pattern(rows: Int64Array, columns: Int64Array, count: int) -> sparse.csc_array:
    unique = np.unique(rows * count + columns)
    ones = np.ones(len(unique))
    return sparse.csc_array((ones, (unique // count, unique % count)), shape=(count, count))


def _elimination_order(pattern: sparse.csc_array) -> Int64Array:
    """Return the blocks in an order that keeps the factor sparse: SuperLU's minimum degree."""
    degrees = np.diff(pattern.indptr).astype(np.float64)
    dominant = sparse.csc_matrix(pattern + sparse.diags_array(2.0 * degrees, format="csc"))
    factor = splu(
        dominant,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    order = np.empty(pattern.shape[0], np.int64)
    order[factor.perm_c] = np.arange(pattern.shape[0])
    return order


def _symbolic(pattern: sparse.csc_array, order: Int64Array) -> tuple[list[set[int]], list[int]]:
    """Return the blocks below each in the factor, and its parent in the elimination tree or -1."""
    position_of = np.empty(len(order), np.int64)
    position_of[order] = np.arange(len(order))
    touched: list[set[int]] = []
    parents: list[int] = []
    waiting: dict[int, list[int]] = {}
    for place, block in enumerate(order):
        near = position_of[pattern.indices[pattern.indptr[block] : pattern.indptr[block + 1]]]
        below = set(near[near > place].tolist())
        for child in waiting.pop(place, ()):
            below |= touched[child]
        below.discard(place)
        parent = min(below, default=-1)
        if parent >= 0:
            waiting.setdefault(parent, []).append(place)
        touched.append(below)
        parents.append(parent)
    return touched, parents


def _merged(touched: list[set[int]], parents: list[int]) -> list[_Front]:
    """Return fronts of consecutive blocks that touch nearly the same others, children first."""
    fronts: list[_Front] = []
    front_of: dict[int, int] = {}
    for place, below in enumerate(touched):
        last = fronts[-1] if fronts else None
        if last is not None and last.columns[-1] == place - 1 and parents[place - 1] == place:
            padding = len(below) + 1 - len(touched[last.columns[0]]) + len(last.columns) - 1
            if padding <= _MAX_PADDING_BLOCKS:
                last.columns.append(place)
                last.touched = sorted(below)
                front_of[place] = len(fronts) - 1
                continue
        front_of[place] = len(fronts)
        fronts.append(_Front([place], sorted(below)))
    for number, front in enumerate(fronts):
        if front.touched:
            front.parent = front_of[front.touched[0]]
            fronts[front.parent].children.append(number)
    return fronts


def _invert(
    matrix: _Matrix, fronts: list[_Front], spans: list[Int64Array]
) -> list[tuple[Int64Array, Float64Array]]:
    """Return, for every front, its scalars' indices and the inverse's entries between them."""
    places = [np.concatenate([spans[k] for k in (*f.columns, *f.touched)]) for f in fronts]
    counts = [sum(len(spans[k]) for k in front.columns) for front in fronts]
    updates: list[Float64Array | None] = [None] * len(fronts)
    factors = []
    for number, front in enumerate(fronts):
        indices, count = places[number], counts[number]
        dense = np.zeros((len(indices), len(indices)))
        matrix.put(dense, indices, count)
        for child in front.children:
            here = np.searchsorted(indices, places[child][counts[child] :])
            update = updates[child]
            assert update is not None
            dense[here[:, None], here] += update
            updates[child] = None
        inverse_root = _inverse_root(dense[:count, :count])
        across = dense[count:, :count] @ inverse_root.T
        updates[number] = dense[count:, count:] - across @ across.T
        factors.append((inverse_root, across @ inverse_root))
    return _back_down(fronts, places, counts, factors)


def _inverse_root(matrix: Float64Array) -> Float64Array:
    """Return the inverse of the lower Cholesky factor."""
    root, failed = lapack.dpotrf(matrix, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError
    inverse: Float64Array = lapack.dtrtri(root, lower=1)[0]
    return inverse


def _back_down(
    fronts: list[_Front],
    places: list[Int64Array],
    counts: list[int],
    factors: list[tuple[Float64Array, Float64Array]],
) -> list[tuple[Int64Array, Float64Array]]:
    inverses: list[tuple[Int64Array, Float64Array]] = [
        (np.empty(0, np.int64), np.empty((0, 0)))
    ] * len(fronts)
    for number in range(len(fronts) - 1, -1, -1):
        indices, count = places[number], counts[number]
        inverse_root, gain = factors[number]
        inverse = np.empty((len(indices), len(indices)))
        inverse[:count, :count] = inverse_root.T @ inverse_root
        if len(indices) > count:
            above, known = inverses[fronts[number].parent]
            here = np.searchsorted(above, indices[count:])
            touched = known[here[:, None], here]
            across = -touched @ gain
            inverse[count:, count:] = touched
            inverse[count:, :count] = across
            inverse[:count, count:] = across.T
            inverse[:count, :count] -= gain.T @ across
        inverses[number] = (indices, inverse)
    return inverses
