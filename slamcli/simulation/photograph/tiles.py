"""Parts of a picture, each with the rays that fall on it."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import undistorted_coordinates

RAYS_ACROSS, RAYS_DOWN = 2, 4
_TILE_PIXELS = 128
_MIN_SPLIT_ROWS = 16


class Tile(NamedTuple):
    """A part of the picture.

    Attributes
    ----------
    rows, columns : slice
        Of the picture.
    rays : (RAYS_DOWN h, RAYS_ACROSS w, 2) float32
        Undistorted pixels of its rays.
    """

    rows: slice
    columns: slice
    rays: Float32Array

    @property
    def half_rays(self) -> Float32Array:
        """(RAYS_DOWN h / 2, RAYS_ACROSS w, 2) float32: means of each two rays above each other."""
        return 0.5 * (self.rays[0::2] + self.rays[1::2])

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.columns.stop - self.columns.start, self.rows.stop - self.rows.start

    def pixels_per_ray(self, rays: Float32Array) -> float:
        """Return the share of a pixel that one of its (half) rays stands for."""
        width, height = self.size
        rows, columns = rays.shape[:2]
        return width * height / float(rows * columns)

    def halves(self) -> tuple[Tile, ...]:
        """Return the upper and the lower half; none when the tile is a few rows high."""
        height = self.size[1]
        if height < _MIN_SPLIT_ROWS:
            return ()
        middle = self.rows.start + height // 2
        cut = (height // 2) * RAYS_DOWN
        upper, lower = slice(self.rows.start, middle), slice(middle, self.rows.stop)
        return (
            Tile(upper, self.columns, self.rays[:cut]),
            Tile(lower, self.columns, self.rays[cut:]),
        )


def make_tiles(calibration: Calibration) -> list[Tile]:
    """Return the tiles of a camera's picture, by its lens."""
    width, height = calibration.image_size
    columns = (np.arange(width * RAYS_ACROSS) + 0.5) / RAYS_ACROSS - 0.5
    rows = (np.arange(height * RAYS_DOWN) + 0.5) / RAYS_DOWN - 0.5
    tiles = []
    for top in range(0, height, _TILE_PIXELS):
        rows_of = slice(top, min(top + _TILE_PIXELS, height))
        # Of one row of tiles at a time: of a whole picture they would take as much as all tiles do.
        of_row = rows[rows_of.start * RAYS_DOWN : rows_of.stop * RAYS_DOWN]
        x, y = (a.astype(np.float32) for a in np.meshgrid(columns, of_row))
        if np.any(calibration.distortion):
            x, y = undistorted_coordinates(calibration, x, y)
        for left in range(0, width, _TILE_PIXELS):
            columns_of = slice(left, min(left + _TILE_PIXELS, width))
            place = slice(columns_of.start * RAYS_ACROSS, columns_of.stop * RAYS_ACROSS)
            tiles.append(Tile(rows_of, columns_of, np.dstack([x[:, place], y[:, place]])))
    return tiles


def rim(rays: Float32Array) -> Float64Array:
    """Return the (N, 2) rays all around a tile: what lies between them lies within on the floor."""
    around = rays[0], rays[-1], rays[:, 0], rays[:, -1]
    return np.concatenate(around).astype(np.float64)


def carry(points: Float64Array, matrix: Float64Array) -> Float64Array:
    """Return (N, 2) points moved by a homography."""
    return np.asarray(cv2.perspectiveTransform(points[None], matrix)[0], np.float64)
