"""Laid floors, periodic ones: tiles, planks and carpet, whose repetition is hard to register.

`wear` 0 makes every piece the same (five prints of planks, one of tiles); with wear each gets its
own tone and its own scratches and stains.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import Grid
from slamcli.simulation.floors.noise import smooth_noise, tinted

TILE_METRES = 0.10
PLANK_METRES = (1.2, 0.19)
_PRINTS = 5
_JOINT_METRES = 0.0012
_GROUT_METRES = 0.003
_TUFT_METRES = 0.004
_SKIRTING_METRES = 0.08


def tiles(grid: Grid, wear: float, seed: int) -> UInt8Array:
    """Paint glazed tiles with one weak print, and grout between them."""
    x, y = _positions(grid)
    column, row = np.floor(x / TILE_METRES).astype(int), np.floor(y / TILE_METRES).astype(int)
    across, along = x - column * TILE_METRES, y - row * TILE_METRES
    gray = 196 + _repeated(_tile_print, grid, (TILE_METRES, TILE_METRES), across, along, seed)
    edge = np.minimum(
        np.minimum(across, TILE_METRES - across), np.minimum(along, TILE_METRES - along)
    )
    gray += wear * 12.0 * _hashed(column, row, seed + 31)
    gray = np.where(edge < _GROUT_METRES / 2, 118.0, gray)
    return tinted((gray + _worn(grid, wear, seed)).astype(np.float32), (0.98, 1.0, 1.02))


def planks(grid: Grid, wear: float, seed: int) -> UInt8Array:
    """Paint laminate: rows of planks, shifted by a third, each one of five prints of grain."""
    length, width = PLANK_METRES
    x, y = _positions(grid)
    row = np.floor(y / width).astype(int)
    shifted = x + (row % 3) * length / 3
    column = np.floor(shifted / length).astype(int)
    across, along = shifted - column * length, y - row * width
    chosen = np.floor((_hashed(column, row, seed + 41) + 1.0) / 2.0 * _PRINTS).astype(int)
    gray = np.zeros(x.shape)
    for number in range(_PRINTS):
        here = chosen == number
        if here.any():
            printed = _repeated(
                _plank_print, grid, PLANK_METRES, across, along, seed + 100 * number
            )
            gray[here] = printed[here]
    edge = np.minimum(np.minimum(across, length - across), np.minimum(along, width - along))
    gray += 138 + wear * 6.0 * _hashed(column, row, seed + 42)
    gray = np.where(edge < _JOINT_METRES / 2, 70.0, gray)
    return tinted((gray + _worn(grid, wear, seed)).astype(np.float32), (0.72, 0.95, 1.15))


def carpet(grid: Grid, wear: float, seed: int) -> UInt8Array:
    """Paint loops of yarn in rows, each its own shade, and trodden patches."""
    x, y = _positions(grid)
    wobble = 0.0006 * smooth_noise(grid, seed + 51, 0.006)
    loops = np.sin(np.pi * (x + wobble) / _TUFT_METRES) * np.sin(np.pi * y / _TUFT_METRES)
    yarn = smooth_noise(grid, seed + 52, 0.0018)
    fibre = smooth_noise(grid, seed + 53, 0.0006, stretch=2.0)
    trodden = smooth_noise(grid, seed + 54, 0.08) + smooth_noise(grid, seed + 55, 0.02)
    gray = 92 + 16 * np.abs(loops) + 11 * yarn + 6 * fibre + (1 + 4 * wear) * trodden
    return tinted(gray.astype(np.float32), (1.08, 0.98, 0.92))


def wall(grid: Grid, wear: float, seed: int) -> UInt8Array:
    """Paint a wall, its foot at y 0: a skirting board, and pictures and shelves above it."""
    _, y = _positions(grid)
    hung = smooth_noise(grid, seed + 56, 0.12) > 0.9
    shade = smooth_noise(grid, seed + 57, 0.05)
    plaster = 178 + 2.0 * smooth_noise(grid, seed + 58, 0.002) + 6.0 * wear * shade
    gray = np.where(hung, 90 + 40 * shade, plaster)
    gray = np.where(y < _SKIRTING_METRES, 60.0, gray)
    return tinted(gray.astype(np.float32), (0.97, 1.0, 1.03))


def _positions(grid: Grid) -> tuple[Float64Array, Float64Array]:
    """Return the world x and y (h, w) of a grid's pixels."""
    matrix = grid.metres_from_pixel
    columns = matrix[0, 0] * np.arange(grid.width) + matrix[0, 2]
    rows = matrix[1, 1] * np.arange(grid.height) + matrix[1, 2]
    x, y = np.meshgrid(columns, rows)
    return x, y


def _hashed(column: NDArray[np.int_], row: NDArray[np.int_], seed: int) -> Float64Array:
    """Return a number in [-1, 1) for each piece, by its position and the seed alone."""
    min_column, min_row = int(column.min()), int(row.min())
    rows = int(row.max()) - min_row + 1
    # One number to a piece: numpy sorts pairs twenty times as slowly.
    pieces, inside = np.unique((column - min_column) * rows + (row - min_row), return_inverse=True)
    values = np.empty(len(pieces))
    for index, piece in enumerate(pieces):
        piece_column, piece_row = divmod(int(piece), rows)
        # Seeds are natural numbers; the offset keeps those of pieces left of the origin so.
        position = piece_column + min_column + 2**31, piece_row + min_row + 2**31
        values[index] = np.random.default_rng([seed, *position]).uniform(-1.0, 1.0)
    return values[inside]


def _repeated(
    printed: Callable[[float, int], Float32Array],
    grid: Grid,
    size_metres: tuple[float, float],
    across: Float64Array,
    along: Float64Array,
    seed: int,
) -> Float64Array:
    """Return a print read at positions (metres) inside a piece."""
    image = printed(grid.metres_per_pixel, seed)
    height, width = image.shape
    column = np.clip((across / size_metres[0] * width).astype(int), 0, width - 1)
    row = np.clip((along / size_metres[1] * height).astype(int), 0, height - 1)
    return np.asarray(image[row, column], np.float64)


@lru_cache(maxsize=4)
def _tile_print(metres_per_pixel: float, seed: int) -> Float32Array:
    grid = _piece(metres_per_pixel, (TILE_METRES, TILE_METRES))
    clouds = smooth_noise(grid, seed + 32, 0.008)
    specks = np.maximum(smooth_noise(grid, seed + 33, 0.0012) - 1.8, 0.0)
    return np.asarray(4.0 * clouds - 22.0 * specks, np.float32)


@lru_cache(maxsize=4 * _PRINTS)
def _plank_print(metres_per_pixel: float, seed: int) -> Float32Array:
    grid = _piece(metres_per_pixel, PLANK_METRES)
    grain = smooth_noise(grid, seed + 43, 0.0009, stretch=30.0)
    rings = smooth_noise(grid, seed + 44, 0.004, stretch=25.0)
    pores = np.maximum(smooth_noise(grid, seed + 45, 0.0006, stretch=12.0) - 1.6, 0.0)
    knots = np.maximum(smooth_noise(grid, seed + 46, 0.008, stretch=1.6) - 2.4, 0.0)
    return np.asarray(9.0 * grain + 14.0 * rings - 30.0 * pores - 60.0 * knots, np.float32)


def _piece(metres_per_pixel: float, size_metres: tuple[float, float]) -> Grid:
    width, height = (round(side / metres_per_pixel) for side in size_metres)
    return Grid(0.0, height * metres_per_pixel, metres_per_pixel, width, height)


def _worn(grid: Grid, wear: float, seed: int) -> Float32Array:
    """Return the traces of wear, (h, w) gray: scratches, stains and dust."""
    if wear == 0.0:
        return np.zeros((grid.height, grid.width), np.float32)
    scratches = np.maximum(smooth_noise(grid, seed + 61, 0.0010, stretch=10.0) - 2.2, 0.0)
    stains = np.maximum(smooth_noise(grid, seed + 62, 0.005) - 2.0, 0.0)
    dust = np.maximum(smooth_noise(grid, seed + 63, 0.0010) - 2.8, 0.0)
    return np.asarray(wear * (50 * scratches - 40 * stains + 60 * dust), np.float32)
