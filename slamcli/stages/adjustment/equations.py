"""The equations of the bundle adjustment: unknowns, residuals, priors and normal matrix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix

from slamcli.core.arrays import BoolArray, Float64Array, Int64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.robust import (
    GEMAN_MCCLURE_SIGMAS,
    NORMAL_MEDIAN,
    RAYLEIGH_MEDIAN,
    geman_mcclure_weights,
)
from slamcli.stages.adjustment.patch_tracking import Matches
from slamcli.stages.adjustment.projection import (
    CAMERA_PARAMETERS,
    FRAME_PARAMETERS,
    POSE_PARAMETERS,
    FramePose,
    transfer_with_jacobians,
)

# [All thresholds here are guarded by benchmarks/self_calibration.py.]
# A match whose one direction is known this much worse than the other lies on a line.
_LINE_RATIO = 0.3
_MIN_SCALE = 0.3
# Priors: no calibration is worse than about this, and what the matches do not observe must not
# diverge. Log focal length, radial coefficients, pitch, roll, principal point (in focal lengths).
_CAMERA_SIGMAS = np.array([0.15, 0.4, 0.4, 0.1, 0.1, 0.02, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The order of the unknowns: the camera's first, then frame by frame."""

    frames: tuple[int, ...]
    free: BoolArray

    @property
    def count(self) -> int:
        """How many unknowns there are."""
        return CAMERA_PARAMETERS + FRAME_PARAMETERS * len(self.frames)

    def of_frame(self, position: int) -> Int64Array:
        """Return (6,): the unknowns of the frame at a position in `frames`."""
        start = CAMERA_PARAMETERS + FRAME_PARAMETERS * position
        return np.arange(start, start + FRAME_PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class BundleState:
    """The current estimate: camera, poses, camera change in all, floor unevenness (m, 1 sigma)."""

    calibration: Calibration
    poses: dict[int, FramePose]
    change: Float64Array
    unevenness_metres: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One pair of frames, linearised, all in standard deviations.

    Attributes
    ----------
    frames : (int, int)
    unknowns : (19,) int
        Indices in the vector of all unknowns.
    residual : (N, 2) float64
    jacobian : (N, 2, 19) float64
    median : (N,) float64
        Of the length of a residual, were it a standard normal one.
    plain, by_rise : (N, 2) float64
        The residual, and its derivative by the height of the floor at the spot (1/m), both as they
        are on an even floor.
    """

    frames: tuple[int, int]
    unknowns: Int64Array
    residual: Float64Array
    jacobian: Float64Array
    median: Float64Array
    plain: Float64Array
    by_rise: Float64Array


def free_unknowns(
    frames: Sequence[int],
    anchors: Sequence[int],
    camera_free: BoolArray,
    rocking_sigmas: Float64Array,
) -> BoolArray:
    """Return (K,) bool: which unknowns are estimated."""
    fixed = set(anchors)
    by_frame = [
        np.concatenate([np.full(POSE_PARAMETERS, index not in fixed), rocking_sigmas > 0.0])
        for index in frames
    ]
    return np.concatenate([camera_free, *by_frame])


def prior_information(layout: Layout, sigmas: Float64Array) -> Float64Array:
    """Return the information (K,) of each unknown's prior, whose mean is zero; 0 without one."""
    rocking = np.where(sigmas > 0.0, 1.0 / np.maximum(sigmas, 1e-12) ** 2, 0.0)
    by_frame = np.concatenate([np.zeros(POSE_PARAMETERS), rocking])
    return np.concatenate([_CAMERA_SIGMAS**-2, np.tile(by_frame, len(layout.frames))])


def prior_residuals(layout: Layout, state: BundleState) -> Float64Array:
    """Return (K,): the deviation of each unknown with a prior from zero."""
    values = np.zeros(layout.count)
    values[:CAMERA_PARAMETERS] = state.change
    height = state.calibration.height_metres
    for position, index in enumerate(layout.frames):
        rocking = state.poses[index].rocking
        values[layout.of_frame(position)[POSE_PARAMETERS:]] = (
            rocking.pitch_radians,
            rocking.roll_radians,
            math.log1p(rocking.height_metres / height),
        )
    return values


def linearise(state: BundleState, matches: Sequence[Matches], layout: Layout) -> list[Block]:
    """Return every pair of frames linearised about a state."""
    positions = {index: position for position, index in enumerate(layout.frames)}
    blocks = []
    for pair in matches:
        own = [layout.of_frame(positions[index]) for index in (pair.a, pair.b)]
        unknowns = np.concatenate([np.arange(CAMERA_PARAMETERS), *own])
        blocks.append(_linearise_pair(state, pair, unknowns))
    return blocks


def _linearise_pair(state: BundleState, pair: Matches, unknowns: Int64Array) -> Block:
    poses = state.poses[pair.a], state.poses[pair.b]
    moved = transfer_with_jacobians(state.calibration, *poses, pair.pixels_a)
    seen = np.isfinite(moved.pixels).all(axis=1)
    whitening = pair.whitening[seen]
    jacobian = np.concatenate([moved.by_camera, moved.by_a, moved.by_b], axis=2)[seen]
    precision = np.linalg.norm(whitening, axis=2)
    plain = np.einsum("nij,nj->ni", whitening, moved.pixels[seen] - pair.pixels_b[seen])
    # Where the floor lies higher, both cameras are nearer to it.
    heights = [state.calibration.height_metres + pose.rocking.height_metres for pose in poses]
    rise = -moved.by_a[seen, :, -1] / heights[0] - moved.by_b[seen, :, -1] / heights[1]
    by_rise = np.einsum("nij,nj->ni", whitening, rise)
    shrink = _shrinking(by_rise * state.unevenness_metres)
    line = precision.min(axis=1) < _LINE_RATIO * precision.max(axis=1)
    return Block(
        (pair.a, pair.b),
        unknowns,
        np.einsum("nij,nj->ni", shrink, plain),
        shrink @ whitening @ jacobian,
        np.where(line, NORMAL_MEDIAN, RAYLEIGH_MEDIAN),
        plain,
        by_rise,
    )


def _shrinking(spread: Float64Array) -> Float64Array:
    """Return (N, 2, 2): the inverse root of ``I + s s^T`` for (N, 2) vectors s."""
    squared = np.einsum("ni,ni->n", spread, spread)
    share = (1.0 - 1.0 / np.sqrt(1.0 + squared)) / np.maximum(squared, 1e-12)
    outer = spread[:, :, None] * spread[:, None, :]
    return np.asarray(np.eye(2) - share[:, None, None] * outer)


def estimate_unevenness(blocks: Sequence[Block], scale: float) -> float:
    """Return the floor's unevenness (m): the excess of residuals along that direction."""
    plain = np.concatenate([block.plain for block in blocks])
    by_rise = np.concatenate([block.by_rise for block in blocks])
    length = np.maximum(np.linalg.norm(by_rise, axis=1), 1e-9)
    along = np.einsum("ni,ni->n", plain, by_rise / length[:, None])
    sensitive = length > np.median(length)
    # The median of a squared normal number is 0.455 times its variance.
    variance = (along[sensitive] / length[sensitive]) ** 2
    even = (scale / length[sensitive]) ** 2
    return math.sqrt(max(float(np.median(variance)) / 0.455 - float(np.median(even)), 0.0))


def residual_scale(blocks: Sequence[Block]) -> float:
    """Return how many times longer residuals are than their sigmas predict (median)."""
    lengths = [np.linalg.norm(block.residual, axis=1) / block.median for block in blocks]
    return max(float(np.median(np.concatenate(lengths))), _MIN_SCALE)


def _squares(block: Block, scale: float) -> Float64Array:
    squares: Float64Array = np.sum(block.residual**2, axis=1) / scale**2
    return squares


def total_cost(
    blocks: Sequence[Block],
    scale: float,
    prior: Float64Array,
    deviation: Float64Array,
) -> float:
    """Return the robust cost of the residuals, and of the deviation (K,) from the prior."""
    total = float(np.sum(prior * deviation**2))
    for block in blocks:
        squares = _squares(block, scale)
        total += float(np.sum(squares / (1.0 + squares / GEMAN_MCCLURE_SIGMAS**2)))
    return total


def weights(block: Block, scale: float) -> Float64Array:
    """Return (N,): the robust weight of each match (Geman and McClure)."""
    weights = geman_mcclure_weights(_squares(block, scale) / GEMAN_MCCLURE_SIGMAS**2)
    return weights / scale**2


def normal_equations(
    blocks: Sequence[Block],
    scale: float,
    prior: Float64Array,
    layout: Layout,
    state: BundleState,
) -> tuple[csc_matrix, Float64Array]:
    """Return the normal matrix (K, K), sparse, and the gradient (K,); identity where fixed."""
    gradient = prior * prior_residuals(layout, state)
    rows, columns, values = [], [], []
    for block in blocks:
        weighted = block.jacobian * weights(block, scale)[:, None, None]
        local = np.einsum("nik,nil->kl", weighted, block.jacobian)
        gradient[block.unknowns] += np.einsum("nik,ni->k", weighted, block.residual)
        row, column = np.meshgrid(block.unknowns, block.unknowns, indexing="ij")
        both = layout.free[row] & layout.free[column]
        rows.append(row[both])
        columns.append(column[both])
        values.append(local[both])
    diagonal = np.arange(layout.count)
    rows.append(diagonal)
    columns.append(diagonal)
    values.append(np.where(layout.free, np.maximum(prior, 1e-9), 1.0))
    shape = (layout.count, layout.count)
    normal = coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape
    )
    return normal.tocsc(), np.where(layout.free, gradient, 0.0)
