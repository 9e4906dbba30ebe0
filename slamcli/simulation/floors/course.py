"""Line courses: white lines and squares on a dark board, such as the one of SoutheastCon 2015."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import Grid, apply_homography
from slamcli.simulation.config import CourseLayout, FloorOptions
from slamcli.simulation.floors.noise import Seed, smooth_noise
from slamcli.simulation.floors.poured import concrete


def course(grid: Grid, options: FloorOptions, seed: Seed) -> UInt8Array:
    """Paint the board on a concrete floor; `wear` 0 is pure black and white."""
    layout, wear = options.layout, options.wear
    board = _inside_board(grid, layout)
    if wear > 0:
        dark, light = _worn_paints(grid, wear, seed)
        surround = concrete(grid, options, seed).astype(np.float32)
    else:
        shape = (grid.height, grid.width)
        dark, light = np.full(shape, 12.0, np.float32), np.full(shape, 235.0, np.float32)
        surround = np.full((grid.height, grid.width, 3), 12.0, np.float32)
    paint = _painted(grid, layout)
    gray = (1.0 - paint) * dark + paint * light
    tinted = gray[..., None] * np.array((1.03, 1.0, 0.98), np.float32)
    mixed = board[..., None] * tinted + (1.0 - board[..., None]) * surround
    return np.asarray(np.clip(np.round(mixed), 0, 255), np.uint8)


def _worn_paints(grid: Grid, wear: float, seed: Seed) -> tuple[Float32Array, Float32Array]:
    """Return the black and the white paint, gray (h, w): roller grain, scuffs, seams and dust."""
    grain = smooth_noise(grid, seed + 21, 0.0012)
    roller = smooth_noise(grid, seed + 22, 0.003, stretch=6.0)
    clouds = smooth_noise(grid, seed + 23, 0.05)
    scuffs = np.maximum(smooth_noise(grid, seed + 24, 0.0012, stretch=14.0) - 2.0, 0.0)
    dust = np.maximum(smooth_noise(grid, seed + 25, 0.0010) - 2.6, 0.0)
    scratches = np.maximum(smooth_noise(grid, seed + 26, 0.0015, stretch=3.0) - 2.2, 0.0)
    chips = np.maximum(smooth_noise(grid, seed + 27, 0.0018) - 2.7, 0.0)
    column, row = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    metres = apply_homography(grid.metres_from_pixel, np.dstack([column, row]))
    seam = np.exp(-(((metres[..., 0]) / 0.0012) ** 2)).astype(np.float32)
    dark = 46 + wear * (5 * grain + 6 * roller + 8 * clouds + 60 * scuffs + 120 * dust)
    dark += wear * (45 * scratches - 30 * seam)
    light = 226 + wear * (3 * grain + 4 * roller + 3 * clouds - 50 * scuffs - 70 * scratches)
    light -= wear * (90 * chips + 40 * seam)
    return dark.astype(np.float32), light.astype(np.float32)


def _inside_board(grid: Grid, layout: CourseLayout) -> Float32Array:
    """Return (h, w): how much of each pixel lies on the board, whose centre is the origin."""
    length, width = layout.board_metres
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    return _filled(grid, [corners])


def _painted(grid: Grid, layout: CourseLayout) -> Float32Array:
    """Return (h, w): how much of each pixel is white paint."""
    half, square = layout.line_metres / 2, layout.square_metres
    shapes = [
        _rectangle(np.minimum(start, end) - half, np.maximum(start, end) + half)
        for start, end in layout.lines
    ]
    shapes += [_rectangle(np.array(low), np.array(low) + square) for low in layout.squares]
    middle = np.array([layout.board_metres[0] / 2, 0.0])
    return _filled(grid, [shape - middle for shape in shapes])


def _rectangle(low: Float64Array, high: Float64Array) -> Float64Array:
    return np.array([low, (high[0], low[1]), high, (low[0], high[1])])


def _filled(grid: Grid, shapes: list[Float64Array]) -> Float32Array:
    """Return the share of each pixel that axis-parallel rectangles cover, exactly."""
    column, row = np.arange(grid.width), np.arange(grid.height)
    centres_x = grid.metres_from_pixel[0, 0] * column + grid.metres_from_pixel[0, 2]
    centres_y = grid.metres_from_pixel[1, 1] * row + grid.metres_from_pixel[1, 2]
    half = grid.metres_per_pixel / 2
    covered = np.zeros((grid.height, grid.width))
    for shape in shapes:
        low, high = shape.min(axis=0), shape.max(axis=0)
        across = _overlap(centres_x - half, centres_x + half, low[0], high[0])
        along = _overlap(centres_y - half, centres_y + half, low[1], high[1])
        np.maximum(covered, along[:, None] * across / grid.metres_per_pixel**2, out=covered)
    return covered.astype(np.float32)


def _overlap(start: Float64Array, end: Float64Array, low: float, high: float) -> Float64Array:
    return np.asarray(np.maximum(np.minimum(end, high) - np.maximum(start, low), 0.0))
