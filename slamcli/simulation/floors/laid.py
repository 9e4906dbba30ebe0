"""Laid floors, periodic ones: tiles, planks and carpet, whose repetition is hard to register.

`wear` 0 makes every piece the same (five prints of planks, one of tiles); with wear each gets its
own tone and its own scratches and stains.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import Grid, apply_homography
from slamcli.simulation.config import FloorOptions
from slamcli.simulation.floors.noise import Seed, smooth_noise, tinted

PLANK_METRES = (1.2, 0.19)
PARQUET_METRES = (0.36, 0.06)
_PRINTS = 5
_JOINT_METRES = 0.0012
_TUFT_METRES = 0.004
_SKIRTING_METRES = 0.08
# Number of the marks' random stream.
_MARKS = 34
_MARK_METRES = (0.003, 0.010)
_MARK_CONTRASTS = (0.10, 0.40)


def tiles(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint glazed tiles with one weak print, grout between them, and marks on each."""
    side = options.tile_metres
    x, y = _positions(grid)
    column, row = np.floor(x / side).astype(int), np.floor(y / side).astype(int)
    across, along = x - column * side, y - row * side
    printed = partial(_tile_print, side)
    gray = 196 + _repeated(printed, grid, (side, side), across, along, seed)
    edge = np.minimum(np.minimum(across, side - across), np.minimum(along, side - along))
    gray += options.wear * 12.0 * _hashed(column, row, seed + 31)
    gray *= _marks(grid, options, x, y, seed)
    gray = np.where(edge < options.grout_metres / 2, 118.0, gray)
    return tinted((gray + _worn(grid, options.wear, seed)).astype(np.float32), (0.98, 1.0, 1.02))


def carpet_tiles(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint carpet tiles of one print, each laid across the ones beside it."""
    side = options.tile_metres
    x, y = _positions(grid)
    column, row = np.floor(x / side).astype(int), np.floor(y / side).astype(int)
    across, along = x - column * side, y - row * side
    turned = (column + row) % 2 == 1
    across, along = np.where(turned, along, across), np.where(turned, side - across, along)
    printed = partial(_carpet_print, side)
    gray = 96 + _repeated(printed, grid, (side, side), across, along, seed)
    gray *= _marks(grid, options, x, y, seed + 1)
    edge = np.minimum(np.minimum(across, side - across), np.minimum(along, side - along))
    gray = np.where(edge < 0.0006, 78.0, gray)
    trodden = smooth_noise(grid, seed + 36, 0.05)
    return tinted((gray + 4 * options.wear * trodden).astype(np.float32), (1.05, 0.98, 0.95))


def parquet(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint a herringbone of short planks, five prints of grain."""
    length, width = PARQUET_METRES
    x, y = _positions(grid)
    # A herringbone repeats along the diagonal; in each band of a plank's width, planks that lie
    # along x follow on planks along y, one width further from band to band.
    column, row = np.floor(x / width).astype(int), np.floor(y / width).astype(int)
    count = round(length / width)
    phase = (column - row) % (2 * count)
    lies = phase < count
    first_column = np.where(lies, column - phase, column)
    first_row = np.where(lies, row, row - (2 * count - 1 - phase))
    across = np.where(lies, x - first_column * width, y - first_row * width)
    along = np.where(lies, y - first_row * width, x - first_column * width)
    chosen = np.floor((_hashed(first_column, first_row, seed + 47) + 1.0) / 2.0 * _PRINTS)
    gray = np.zeros(x.shape)
    for number in range(_PRINTS):
        here = chosen == number
        if here.any():
            grain = partial(_plank_print, PARQUET_METRES)
            gray[here] = _repeated(grain, grid, PARQUET_METRES, across, along, seed + 100 * number)[
                here
            ]
    edge = np.minimum(np.minimum(across, length - across), np.minimum(along, width - along))
    gray += np.where(lies, 150, 134) + options.wear * 6.0 * _hashed(first_column, first_row, seed)
    gray = np.where(edge < _JOINT_METRES / 3, 80.0, gray)
    return tinted((gray + _worn(grid, options.wear, seed)).astype(np.float32), (0.66, 0.94, 1.18))


class Mark(NamedTuple):
    """A spot on a tile: an ellipse along the axes, darker or lighter than what it lies on.

    Attributes
    ----------
    centre, radii : (2,) float64
        World metres.
    contrast : float
        By which share it is lighter.
    """

    centre: Float64Array
    radii: Float64Array
    contrast: float


def tile_marks(options: FloorOptions, column: int, row: int, seed: int) -> list[Mark]:
    """Return the marks of one of the `tiles`, which is `column` and `row` tiles from the origin."""
    generator = (Seed(seed) + _MARKS).generator(column, row)
    marks = []
    for _ in range(options.marks):
        centre = generator.uniform(0.0, options.tile_metres, 2)
        radii = generator.uniform(*_MARK_METRES) / 2 * generator.uniform(0.6, 1.0, 2)
        contrast = generator.uniform(*_MARK_CONTRASTS) * generator.choice((-1.0, 0.6))
        centre += np.array([column, row]) * options.tile_metres
        marks.append(Mark(centre, radii, float(contrast)))
    return marks


def _marks(
    grid: Grid, options: FloorOptions, x: Float64Array, y: Float64Array, seed: Seed
) -> Float32Array:
    """Return what the marks leave of each pixel: 1 beside them, (h, w)."""
    left = np.ones((grid.height, grid.width), np.float32)
    if not options.marks:
        return left
    side, reach = options.tile_metres, _MARK_METRES[1]
    columns = range(int((x.min() - reach) // side), int((x.max() + reach) // side) + 1)
    rows = range(int((y.min() - reach) // side), int((y.max() + reach) // side) + 1)
    for column, row in itertools.product(columns, rows):
        for mark in tile_marks(options, column, row, seed.number):
            _add_mark(left, grid, mark)
    return left


def _add_mark(left: Float32Array, grid: Grid, mark: Mark) -> None:
    """Darken or lighten an ellipse whose rim is half a millimetre wide."""
    pixel = apply_homography(grid.pixel_from_metres, mark.centre)
    size = mark.radii / grid.metres_per_pixel
    low = np.floor(pixel - size - 2).astype(int)
    high = np.ceil(pixel + size + 2).astype(int) + 1
    columns = slice(max(0, low[0]), min(grid.width, high[0]))
    rows = slice(max(0, low[1]), min(grid.height, high[1]))
    if columns.start >= columns.stop or rows.start >= rows.stop:
        return
    across = (np.arange(columns.start, columns.stop) - pixel[0]) / size[0]
    along = (np.arange(rows.start, rows.stop) - pixel[1]) / size[1]
    inside = 1.0 - np.hypot(across[None, :], along[:, None])
    rim = 0.0005 / float(mark.radii.min())
    left[rows, columns] *= 1.0 + mark.contrast * np.clip(inside / rim + 0.5, 0.0, 1.0)


def planks(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
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
                partial(_plank_print, PLANK_METRES),
                grid,
                PLANK_METRES,
                across,
                along,
                seed + 100 * number,
            )
            gray[here] = printed[here]
    edge = np.minimum(np.minimum(across, length - across), np.minimum(along, width - along))
    gray += 138 + options.wear * 6.0 * _hashed(column, row, seed + 42)
    gray = np.where(edge < _JOINT_METRES / 2, 70.0, gray)
    return tinted((gray + _worn(grid, options.wear, seed)).astype(np.float32), (0.72, 0.95, 1.15))


def carpet(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint loops of yarn in rows, each its own shade, and trodden patches."""
    x, y = _positions(grid)
    wobble = 0.0006 * smooth_noise(grid, seed + 51, 0.006)
    loops = np.sin(np.pi * (x + wobble) / _TUFT_METRES) * np.sin(np.pi * y / _TUFT_METRES)
    yarn = smooth_noise(grid, seed + 52, 0.0018)
    fibre = smooth_noise(grid, seed + 53, 0.0006, stretch=2.0)
    trodden = smooth_noise(grid, seed + 54, 0.08) + smooth_noise(grid, seed + 55, 0.02)
    gray = 92 + 16 * np.abs(loops) + 11 * yarn + 6 * fibre + (1 + 4 * options.wear) * trodden
    return tinted(gray.astype(np.float32), (1.08, 0.98, 0.92))


def wall(grid: Grid, wear: float, seed: Seed) -> UInt8Array:
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


def _hashed(column: NDArray[np.int_], row: NDArray[np.int_], seed: Seed) -> Float64Array:
    """Return a number in [-1, 1) for each piece, by its place and the seed alone."""
    left, top = int(column.min()), int(row.min())
    values = np.empty((int(row.max()) - top + 1, int(column.max()) - left + 1))
    for place in np.ndindex(values.shape):
        values[place] = seed.generator(place[1] + left, place[0] + top).uniform(-1.0, 1.0)
    return values[row - top, column - left]


def _repeated(
    printed: Callable[[float, Seed], Float32Array],
    grid: Grid,
    size_metres: tuple[float, float],
    across: Float64Array,
    along: Float64Array,
    seed: Seed,
) -> Float64Array:
    """Return a print read at positions (metres) inside a piece."""
    image = printed(grid.metres_per_pixel, seed)
    height, width = image.shape
    column = np.clip((across / size_metres[0] * width).astype(int), 0, width - 1)
    row = np.clip((along / size_metres[1] * height).astype(int), 0, height - 1)
    return np.asarray(image[row, column], np.float64)


@lru_cache(maxsize=4)
def _tile_print(side_metres: float, metres_per_pixel: float, seed: Seed) -> Float32Array:
    grid = _piece(metres_per_pixel, (side_metres, side_metres))
    clouds = smooth_noise(grid, seed + 32, 0.008)
    specks = np.maximum(smooth_noise(grid, seed + 33, 0.0012) - 1.8, 0.0)
    return np.asarray(4.0 * clouds - 22.0 * specks, np.float32)


@lru_cache(maxsize=4)
def _carpet_print(side_metres: float, metres_per_pixel: float, seed: Seed) -> Float32Array:
    grid = _piece(metres_per_pixel, (side_metres, side_metres))
    yarn = smooth_noise(grid, seed + 37, 0.0012, stretch=3.0)
    bands = smooth_noise(grid, seed + 38, 0.01, stretch=6.0)
    return np.asarray(9.0 * yarn + 7.0 * bands, np.float32)


@lru_cache(maxsize=4 * _PRINTS)
def _plank_print(
    size_metres: tuple[float, float], metres_per_pixel: float, seed: Seed
) -> Float32Array:
    grid = _piece(metres_per_pixel, size_metres)
    grain = smooth_noise(grid, seed + 43, 0.0009, stretch=30.0)
    rings = smooth_noise(grid, seed + 44, 0.004, stretch=25.0)
    pores = np.maximum(smooth_noise(grid, seed + 45, 0.0006, stretch=12.0) - 1.6, 0.0)
    knots = np.maximum(smooth_noise(grid, seed + 46, 0.008, stretch=1.6) - 2.4, 0.0)
    return np.asarray(9.0 * grain + 14.0 * rings - 30.0 * pores - 60.0 * knots, np.float32)


def _piece(metres_per_pixel: float, size_metres: tuple[float, float]) -> Grid:
    width, height = (round(side / metres_per_pixel) for side in size_metres)
    return Grid(0.0, height * metres_per_pixel, metres_per_pixel, width, height)


def _worn(grid: Grid, wear: float, seed: Seed) -> Float32Array:
    """Return the traces of wear, (h, w) gray: scratches, stains and dust."""
    if wear == 0.0:
        return np.zeros((grid.height, grid.width), np.float32)
    scratches = np.maximum(smooth_noise(grid, seed + 61, 0.0010, stretch=10.0) - 2.2, 0.0)
    stains = np.maximum(smooth_noise(grid, seed + 62, 0.005) - 2.0, 0.0)
    dust = np.maximum(smooth_noise(grid, seed + 63, 0.0010) - 2.8, 0.0)
    return np.asarray(wear * (50 * scratches - 40 * stains + 60 * dust), np.float32)
