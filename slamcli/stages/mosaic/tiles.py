"""Tiles of the unbounded raster of the map, and the cells that each tile is divided into."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Grid

TILE_PIXELS = 512
# Whether a view shows floor, and which view is the best, is decided a cell at a time.
CELL_PIXELS = 8
# Decisions use a margin this wide, so that neighbouring tiles decide alike along their border.
MARGIN_CELLS = 12


@dataclass(frozen=True, slots=True, order=True)
class TileKey:
    """Row (downwards) and column (to the right) of a tile; four tiles meet at the map's origin."""

    row: int
    column: int


def tile_grid(key: TileKey, metres_per_pixel: float, margin_pixels: int = 0) -> Grid:
    """Return a tile's raster in the map, with a margin on every side."""
    side = TILE_PIXELS + 2 * margin_pixels
    return Grid(
        (key.column * TILE_PIXELS - margin_pixels) * metres_per_pixel,
        -(key.row * TILE_PIXELS - margin_pixels) * metres_per_pixel,
        metres_per_pixel,
        side,
        side,
    )


def cell_grid(key: TileKey, metres_per_pixel: float) -> Grid:
    """Return the raster of a tile's cells, margin included."""
    scale = metres_per_pixel * CELL_PIXELS
    count = TILE_PIXELS // CELL_PIXELS
    return Grid(
        (key.column * count - MARGIN_CELLS) * scale,
        -(key.row * count - MARGIN_CELLS) * scale,
        scale,
        count + 2 * MARGIN_CELLS,
        count + 2 * MARGIN_CELLS,
    )


def tiles_under(outline: Float64Array, metres_per_pixel: float) -> list[TileKey]:
    """Return the keys of the tiles that a convex outline, (N, 2) metres in the map, may touch.

    By the separating axes of the outline's own edges: a tile wholly outside of one is not touched.
    """
    side = TILE_PIXELS * metres_per_pixel
    low = np.floor(outline.min(axis=0) / side).astype(int)
    high = np.floor(outline.max(axis=0) / side).astype(int)
    columns, lines = np.meshgrid(
        np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1), indexing="xy"
    )
    corners = np.stack(
        [
            np.stack([(columns + right) * side, (lines + up) * side], axis=-1)
            for right in (0, 1)
            for up in (0, 1)
        ]
    )
    edges = np.roll(outline, -1, axis=0) - outline
    inward = np.column_stack([-edges[:, 1], edges[:, 0]])
    area = float(np.sum(outline[:, 0] * edges[:, 1] - outline[:, 1] * edges[:, 0]))
    inward *= 1.0 if area >= 0 else -1.0
    farthest = (corners @ inward.T).max(axis=0) - np.einsum("ni,ni->n", outline, inward)
    touched = (farthest >= 0).all(axis=-1)
    return [
        TileKey(-int(line) - 1, int(column))
        for column, line in zip(columns[touched], lines[touched], strict=True)
    ]


def whole_tiles(grid: Grid) -> Grid:
    """Return the grid of whole tiles around another."""
    side = TILE_PIXELS
    left, top = (
        round(grid.x_min / grid.metres_per_pixel),
        round(-grid.y_max / grid.metres_per_pixel),
    )
    before, above = left % side, top % side
    width, height = -(-(grid.width + before) // side), -(-(grid.height + above) // side)
    return grid.window(-before, -above, width * side, height * side)


def extent_of(keys: Iterable[TileKey], metres_per_pixel: float) -> Grid | None:
    """Return the smallest grid of whole tiles that contains all of `keys`; None for none."""
    found = list(keys)
    if not found:
        return None
    rows, columns = [key.row for key in found], [key.column for key in found]
    first = tile_grid(TileKey(min(rows), min(columns)), metres_per_pixel)
    return first.window(
        0,
        0,
        (max(columns) - min(columns) + 1) * TILE_PIXELS,
        (max(rows) - min(rows) + 1) * TILE_PIXELS,
    )
