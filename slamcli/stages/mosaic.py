"""The map's picture: every frame painted once more, from where its final pose says it stood.

Each pixel of the map is resampled once, straight from the camera's picture, and kept from the view
that saw that spot most sharply: far pixels are smeared over much floor and lean away with whatever
stands there, so averaging them in would only blur the near ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from slamcli.core.geometry import Grid
from slamcli.core.records import Tile

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

TILE_PIXELS = 512
# Towards the border of what a picture shows its weight falls to nothing over this many pixels.
_BORDER_PIXELS = 24


@dataclass(frozen=True, slots=True)
class TileKey:
    """Column (to the right) and row (upwards) of a tile in the endless raster of the map."""

    column: int
    row: int


def picture_weight(sharpness: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (H, W): how well each pixel of a camera's picture shows the floor.

    Its sharpness (pixels per metre), fading to nothing towards the border of what is usable.
    """
    usable = np.pad(np.where(sharpness > 0, np.uint8(255), np.uint8(0)), 1)
    distance = np.asarray(cv2.distanceTransform(usable, cv2.DIST_L2, 3))[1:-1, 1:-1]
    fading = np.minimum(distance * np.float32(1.0 / _BORDER_PIXELS), np.float32(1.0))
    weight: NDArray[np.float32] = sharpness * fading
    return weight


class Canvas:
    """A sparse raster of tiles: only what was seen takes memory."""

    def __init__(self, metres_per_pixel: float) -> None:
        self.metres_per_pixel = metres_per_pixel
        self._tiles: dict[TileKey, tuple[NDArray[np.uint8], NDArray[np.float32]]] = {}

    def paint(self, patch: Tile) -> None:
        """Put a patch in, where it was seen better than what is there; ties keep the earlier."""
        grid = patch.grid
        left = round(grid.x_min / self.metres_per_pixel)
        top = round(-grid.y_max / self.metres_per_pixel)
        for tile_row in range(top // TILE_PIXELS, (top + grid.height - 1) // TILE_PIXELS + 1):
            for tile_column in range(
                left // TILE_PIXELS, (left + grid.width - 1) // TILE_PIXELS + 1
            ):
                row, column = tile_row * TILE_PIXELS - top, tile_column * TILE_PIXELS - left
                self._paint_tile(TileKey(tile_column, tile_row), patch, row, column)

    def _paint_tile(self, key: TileKey, patch: Tile, row: int, column: int) -> None:
        """Blend the patch's part in the tile that starts at patch pixel (row, column)."""
        height, width = patch.weight.shape
        rows = slice(max(0, row), min(height, row + TILE_PIXELS))
        columns = slice(max(0, column), min(width, column + TILE_PIXELS))
        weight = patch.weight[rows, columns]
        if not weight.any():
            return
        if key not in self._tiles:
            shape = (TILE_PIXELS, TILE_PIXELS)
            self._tiles[key] = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32)
        image, best = self._tiles[key]
        inside_rows = slice(rows.start - row, rows.stop - row)
        inside_columns = slice(columns.start - column, columns.stop - column)
        better = weight > best[inside_rows, inside_columns]
        np.copyto(best[inside_rows, inside_columns], weight, where=better)
        np.copyto(
            image[inside_rows, inside_columns],
            patch.image[rows, columns],
            where=better[..., None],
        )

    def tiles(self) -> Iterable[Tile]:
        """Yield the painted tiles, rows from the top, columns from the left."""
        side = TILE_PIXELS * self.metres_per_pixel
        for key in sorted(self._tiles, key=lambda key: (key.row, key.column)):
            image, weight = self._tiles[key]
            grid = Grid(
                key.column * side, -key.row * side, self.metres_per_pixel, TILE_PIXELS, TILE_PIXELS
            )
            yield Tile(grid, image, weight)

    def seen_area(self) -> float:
        """Return the floor that was seen, in square metres."""
        pixels = sum(int(np.count_nonzero(weight)) for _, weight in self._tiles.values())
        return pixels * self.metres_per_pixel**2

    def extent(self) -> Grid | None:
        """Return the smallest grid that covers every seen pixel; None when nothing was."""
        corners = []
        for tile in self.tiles():
            rows, columns = np.nonzero(tile.weight)
            window = tile.grid.window(
                int(columns.min()),
                int(rows.min()),
                int(np.ptp(columns)) + 1,
                int(np.ptp(rows)) + 1,
            )
            corners.append(window.corners)
        if not corners:
            return None
        points = np.vstack(corners)
        low, high = points.min(axis=0), points.max(axis=0)
        scale = self.metres_per_pixel
        return Grid(
            float(low[0]),
            float(high[1]),
            scale,
            round((high[0] - low[0]) / scale),
            round((high[1] - low[1]) / scale),
        )

    def flatten(self, grid: Grid) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return the picture (h, w, 3) BGR of a grid on whole map pixels, and its mask (h, w)."""
        image = np.zeros((grid.height, grid.width, 3), np.uint8)
        mask = np.zeros((grid.height, grid.width), np.uint8)
        for tile in self.tiles():
            row = round((grid.y_max - tile.grid.y_max) / self.metres_per_pixel)
            column = round((tile.grid.x_min - grid.x_min) / self.metres_per_pixel)
            rows = slice(max(0, row), min(grid.height, row + TILE_PIXELS))
            columns = slice(max(0, column), min(grid.width, column + TILE_PIXELS))
            if rows.start >= rows.stop or columns.start >= columns.stop:
                continue
            source = (
                slice(rows.start - row, rows.stop - row),
                slice(columns.start - column, columns.stop - column),
            )
            image[rows, columns] = tile.image[source]
            mask[rows, columns] = np.where(tile.weight[source] > 0, np.uint8(255), np.uint8(0))
        return image, mask
