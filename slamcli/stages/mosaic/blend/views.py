"""The views of one tile before blending, the result, and the step from cells to pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, IntpArray, UInt8Array
from slamcli.stages.mosaic.channels import three_channels
from slamcli.stages.mosaic.sampling import Sample
from slamcli.stages.mosaic.tiles import CELL_PIXELS, MARGIN_CELLS

# Around a view's own cells this many more are read, for where another turns out not to see all of
# its own; there it counts this little [guarded by benchmarks/blends.py].
SPARE_CELLS = 2
_SPARE_SHARE = np.float32(1e-3)
# Windows that less of is filled are halved, down to this side: each takes a time of its own
# [benchmarks/stages.py].
_MIN_FILLED_SHARE, _MIN_SIDE_CELLS = 0.6, 8
# How much steeper than linear feathering is: a seam is one cell wide at 1, half a cell at 2
# [guarded by benchmarks/blends.py].
_STEEPNESS = 2.0


@dataclass(frozen=True, slots=True)
class CellWindow:
    """A rectangle of a tile, in its cells; the margin's are negative or beyond the tile."""

    row: int
    column: int
    height: int
    width: int

    @property
    def pixels(self) -> tuple[slice, slice]:
        """Rows and columns in the tile's pixels."""
        return (
            slice(self.row * CELL_PIXELS, (self.row + self.height) * CELL_PIXELS),
            slice(self.column * CELL_PIXELS, (self.column + self.width) * CELL_PIXELS),
        )

    @property
    def cells(self) -> tuple[slice, slice]:
        """Rows and columns in an array of the tile's cells, margin included."""
        row, column = self.row + MARGIN_CELLS, self.column + MARGIN_CELLS
        return slice(row, row + self.height), slice(column, column + self.width)


class Reader(Protocol):
    """Reads one view of a tile at full resolution."""

    def __call__(self, index: int, window: CellWindow) -> Sample:
        """Return what the view with an index in `Views` shows of a window."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What is known of a tile before its pixels are read.

    Attributes
    ----------
    cells : (N, h, w, 3) uint8
        What each view shows of each cell, margin included.
    weights : (N, h, w) float32
        Resolution, pixels per metre, fading towards an image's border; 0 where the view does not
        see the cell, or shows something other than floor.
    read : Reader
    """

    cells: UInt8Array
    weights: Float32Array
    read: Reader


@dataclass(frozen=True, slots=True, eq=False)
class Blended:
    """The blended image of a tile.

    Attributes
    ----------
    image : (TILE_PIXELS, TILE_PIXELS, 3) uint8
    pixels_per_metre : (TILE_PIXELS, TILE_PIXELS) float32
        Resolution of the best view that contributes; 0: nothing seen.
    """

    image: UInt8Array
    pixels_per_metre: Float32Array


def best_view(weights: Float32Array) -> IntpArray:
    """Return (h, w): the view that sees each cell best, without islands; -1 where none does."""
    smooth = np.stack([cv2.blur(one, (3, 3)) for one in weights])
    smooth[weights <= 0] = 0.0
    label = np.argmax(smooth, axis=0)
    return np.where((weights > 0).any(axis=0), label, -1)


def window_around(cells: BoolArray) -> CellWindow | None:
    """Return the smallest window of the tile proper around some cells; None when none is in it."""
    inner = cells[MARGIN_CELLS:-MARGIN_CELLS, MARGIN_CELLS:-MARGIN_CELLS]
    return _tightened(CellWindow(0, 0, *inner.shape), inner)


def windows_around(cells: BoolArray) -> list[CellWindow]:
    """Return windows that cover the cells of the tile proper, few and mostly filled by them.

    What a view sees best is often a narrow strip across the tile, whose smallest window is mostly
    of other views.
    """
    open_windows, found = [window_around(cells)], list[CellWindow]()
    while open_windows:
        window = open_windows.pop()
        if window is None:
            continue
        inside = cells[window.cells]
        if inside.mean() >= _MIN_FILLED_SHARE or max(inside.shape) < 2 * _MIN_SIDE_CELLS:
            found.append(window)
            continue
        row, column, height, width = window.row, window.column, window.height, window.width
        if height >= width:
            half = height // 2
            first = CellWindow(row, column, half, width)
            second = CellWindow(row + half, column, height - half, width)
        else:
            half = width // 2
            first = CellWindow(row, column, height, half)
            second = CellWindow(row, column + half, height, width - half)
        open_windows += [_tightened(part, cells[part.cells]) for part in (second, first)]
    return found


def _tightened(window: CellWindow, cells: BoolArray) -> CellWindow | None:
    """Return the smallest part of a window around its cells; None when it has none."""
    rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    if rows.size == 0:
        return None
    return CellWindow(
        window.row + int(rows[0]),
        window.column + int(columns[0]),
        int(rows[-1] - rows[0]) + 1,
        int(columns[-1] - columns[0]) + 1,
    )


def dilated(cells: Float32Array, reach: int) -> Float32Array:
    """Return (h, w): the maximum over `reach` cells around each."""
    side = 2 * reach + 1
    return np.asarray(cv2.dilate(cells, np.ones((side, side), np.uint8)), np.float32)


def enlarged(cells: Float32Array, window: CellWindow) -> Float32Array:
    """Return a window of cells at the resolution of pixels."""
    rows, columns = window.cells
    # One cell more on each side, so that windows meet as if they had been enlarged in one.
    wide = cells[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1]
    size = (wide.shape[1] * CELL_PIXELS, wide.shape[0] * CELL_PIXELS)
    large = np.asarray(cv2.resize(wide, size, interpolation=cv2.INTER_LINEAR), np.float32)
    return large[CELL_PIXELS:-CELL_PIXELS, CELL_PIXELS:-CELL_PIXELS]


def feathered(own: Float32Array, window: CellWindow) -> Float32Array:
    """Return the share of each pixel that a view claims: all of its own cells, a trace around.

    Parameters
    ----------
    own : (h, w) float32
        1 in the view's own cells, else 0; margin included.
    """
    ramp = enlarged(own, window)
    steep = np.clip((ramp - 0.5) * np.float32(_STEEPNESS) + 0.5, 0.0, 1.0)
    spare = enlarged(dilated(own, SPARE_CELLS), window)
    claim: Float32Array = np.maximum(steep, spare * _SPARE_SHARE)
    return claim.astype(np.float32)


def weighted_mean(total: Float32Array, share: Float32Array) -> UInt8Array:
    """Return (h, w, 3): a weighted sum divided by the sum of its weights (h, w)."""
    divisor = np.maximum(share, np.float32(1e-9))
    return np.asarray(cv2.divide(total, three_channels(divisor), dtype=cv2.CV_8U), np.uint8)
