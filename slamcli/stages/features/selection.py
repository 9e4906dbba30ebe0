"""Keypoint selection: on seen floor, strong, and spread; and pixels of a pyramid level."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from slamcli.core.config import FeatureOptions
from slamcli.core.geometry import Grid

# Pixels to the side of one value of DetectorInput.clearance.
CLEARANCE_STEP = 4
# Enough that a cell of sharp paint gives more points than one of dull floor, which matches worse
# [guarded by benchmarks/robustness.py].
_POINTS_PER_CELL = 16


@dataclass(frozen=True, slots=True, eq=False)
class DetectorInput:
    """The picture in which a detector finds points, and where they may lie.

    Attributes
    ----------
    gray : (h, w) uint8
        Cleaned, if the options say so.
    allowed : (h, w) uint8
        255 where a point may lie.
    clearance : (h / 4, w / 4) float32 or None
        Pixels to the nearest that was not seen, one value for `CLEARANCE_STEP` pixels each way;
        None without a region of interest.
    """

    gray: UInt8Array
    allowed: UInt8Array
    clearance: Float32Array | None


def choose(
    picture: DetectorInput,
    pixels: Float64Array,
    responses: Float32Array,
    scales: Float64Array | float,
    options: FeatureOptions,
) -> Int64Array:
    """Return which points to keep: patches wholly on seen floor, strong, spread if so chosen.

    Parameters
    ----------
    picture : DetectorInput
    pixels : (N, 2) float64
    responses : (N,) float32
    scales : (N,) float64 or float
        Pixels of the picture to one of the pyramid level.
    options : FeatureOptions

    Returns
    -------
    (M,) int64
        In rising order.
    """
    keep = np.arange(len(pixels))
    if picture.clearance is not None:
        column, row = np.rint(pixels).astype(np.int64).T // CLEARANCE_STEP
        rows, columns = picture.clearance.shape
        clearance = picture.clearance[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
        keep = np.flatnonzero(clearance > options.roi_border_pixels * np.maximum(scales, 1.0))
    if len(keep) > options.count:
        if options.spread:
            area = float(np.count_nonzero(picture.allowed))
            cell = np.sqrt(_POINTS_PER_CELL * area / options.count)
            order = _spread_order(pixels[keep], responses[keep], max(cell, 1.0))
        else:
            order = np.argsort(-responses[keep], kind="stable")
        keep = np.sort(keep[order[: options.count]])
    return keep


def _spread_order(pixels: Float64Array, responses: Float32Array, cell_pixels: float) -> Int64Array:
    """Order points so that any first few are spread: each cell's strongest, then its second ..."""
    column, row = np.floor(pixels / cell_pixels).astype(np.int64).T
    cell = row * (column.max() + 1) + column
    by_cell = np.lexsort((-responses, cell))
    cell = cell[by_cell]
    starts = np.flatnonzero(np.r_[True, cell[1:] != cell[:-1]])
    rank = np.empty(len(cell), dtype=np.int64)
    lengths = np.diff(np.r_[starts, len(cell)])
    rank[by_cell] = np.arange(len(cell)) - np.repeat(starts, lengths)
    return np.lexsort((-responses, rank))


def pixel_from_level(full_shape: tuple[int, ...], level_shape: tuple[int, ...]) -> Float64Array:
    """(3, 3): pixel of a pyramid level to pixel of the picture; their outer corners coincide."""
    fine = Grid(0.0, 0.0, 1.0, 1, 1)
    across, down = (
        fine.pixel_from_metres
        @ Grid(0.0, 0.0, full_shape[axis] / level_shape[axis], 1, 1).metres_from_pixel
        for axis in (1, 0)
    )
    return np.array([across[0], down[1], [0.0, 0.0, 1.0]])
