"""Squared paper with handwriting: lines that repeat everywhere, numbers that are unique."""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import Grid
from slamcli.simulation.config import FloorOptions
from slamcli.simulation.floors.noise import Seed, smooth_noise, tinted

# Figures stand in cells of this side, one in three of them empty.
_CELL_METRES = 0.05
_RULE_GRAY, _INK_GRAY = 178.0, 52.0


def paper(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint ruled squares of `tile_metres` / 20 with lines a tenth as wide, and pen strokes."""
    square = options.tile_metres / 20.0
    matrix = grid.metres_from_pixel
    x = matrix[0, 0] * np.arange(grid.width) + matrix[0, 2]
    y = matrix[1, 1] * np.arange(grid.height) + matrix[1, 2]
    width = max(0.1 * square, grid.metres_per_pixel)
    ruled_x = np.clip(1.0 - np.abs((x / square + 0.5) % 1.0 - 0.5) * square / width, 0.0, 1.0)
    ruled_y = np.clip(1.0 - np.abs((y / square + 0.5) % 1.0 - 0.5) * square / width, 0.0, 1.0)
    ruled = np.maximum(ruled_x[None, :], ruled_y[:, None])
    sheet = 236.0 + 1.5 * smooth_noise(grid, seed + 91, 0.0006)
    sheet += 3.0 * options.wear * smooth_noise(grid, seed + 92, 0.05)
    gray = sheet + ruled * (_RULE_GRAY - sheet)
    ink = _handwriting(grid, x, y, seed + 93)
    gray += ink * (_INK_GRAY - gray)
    return tinted(gray.astype(np.float32), (1.0, 0.99, 0.97))


def _handwriting(grid: Grid, x: Float64Array, y: Float64Array, seed: Seed) -> Float32Array:
    """Return the share of ink in each pixel, (h, w) from 0 to 1."""
    ink = np.zeros((grid.height, grid.width), np.uint8)
    columns = range(int(x.min() // _CELL_METRES) - 1, int(x.max() // _CELL_METRES) + 2)
    rows = range(int(y.min() // _CELL_METRES) - 1, int(y.max() // _CELL_METRES) + 2)
    scale = 1.0 / grid.metres_per_pixel
    for column, row in itertools.product(columns, rows):
        generator = seed.generator(column, row)
        if generator.uniform() < 1 / 3:
            continue
        text = str(generator.integers(0, 100))
        place = generator.uniform(0.1, 0.5, 2) * _CELL_METRES
        left = (column * _CELL_METRES + place[0] - grid.x_min) * scale
        base = (grid.y_max - row * _CELL_METRES - place[1]) * scale
        size = generator.uniform(0.018, 0.028) * scale / 22.0
        thick = max(1, round(0.0009 * scale))
        where = round(left * 16), round(base * 16)
        font = cv2.FONT_HERSHEY_SCRIPT_SIMPLEX
        cv2.putText(
            ink, text, (where[0] // 16, where[1] // 16), font, size, 255, thick, cv2.LINE_AA
        )
    return ink.astype(np.float32) / 255.0
