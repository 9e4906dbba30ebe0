"""Noise that depends on the seed and its position alone, so that blocks meet without a seam."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.geometry import Grid

# White noise is drawn in pieces of this side, to draw few more pixels than a block needs.
_NOISE_PIXELS = 128
# Pieces of 64 KiB that the next blocks need again: of a row of blocks, for all kinds of noise.
_KEPT_PIECES = 1536


def white_noise(grid: Grid, seed: int, margin: int = 0) -> Float32Array:
    """Return standard normal pixels, `margin` wider all round, that depend on position alone."""
    left = round(grid.x_min / grid.metres_per_pixel) - margin
    top = round(-grid.y_max / grid.metres_per_pixel) - margin
    height, width = grid.height + 2 * margin, grid.width + 2 * margin
    noise = np.empty((height, width), np.float32)
    side = _NOISE_PIXELS
    for row in range(top // side, (top + height - 1) // side + 1):
        for column in range(left // side, (left + width - 1) // side + 1):
            block = _white_piece(seed, row, column)
            y, x = row * side - top, column * side - left
            rows = slice(max(0, y), min(height, y + side))
            columns = slice(max(0, x), min(width, x + side))
            noise[rows, columns] = block[
                rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
            ]
    return noise


@lru_cache(maxsize=_KEPT_PIECES)
def _white_piece(seed: int, row: int, column: int) -> Float32Array:
    # Seeds are natural numbers; the offset keeps those of pieces left of the origin so.
    generator = np.random.default_rng([seed, row + 2**31, column + 2**31])
    return generator.standard_normal((_NOISE_PIXELS, _NOISE_PIXELS), dtype=np.float32)


def smooth_noise(grid: Grid, seed: int, sigma_metres: float, stretch: float = 1.0) -> Float32Array:
    """Return (h, w) noise of unit variance with blobs of a size, `stretch` times longer along x.

    Large blobs are made at a coarser scale and enlarged: the same look for a fraction of the work.
    """
    sigma = sigma_metres / grid.metres_per_pixel
    coarse = 1
    while sigma / coarse > 8.0:
        coarse *= 2
    scale = grid.metres_per_pixel * coarse
    margin = int(4 * sigma * max(1.0, stretch) / coarse) + 4
    small = Grid(
        grid.x_min, grid.y_max, scale, -(-grid.width // coarse) + 1, -(-grid.height // coarse) + 1
    )
    noise = white_noise(small, seed, margin)
    sigma_y = max(sigma / coarse, 0.4)
    sigma_x = sigma_y * stretch
    blurred = cv2.GaussianBlur(noise, (0, 0), sigma_x, sigmaY=sigma_y)
    # White noise blurred by a Gaussian keeps 1 / (4 pi sigma_x sigma_y) of its variance.
    blurred = blurred * np.float32(np.sqrt(4 * np.pi * sigma_x * sigma_y))
    inner = blurred[margin:-margin, margin:-margin]
    if coarse == 1:
        return np.ascontiguousarray(inner[: grid.height, : grid.width])
    fine = np.arange(grid.width, dtype=np.float32), np.arange(grid.height, dtype=np.float32)
    small_from_fine = small.pixel_from_metres @ grid.metres_from_pixel
    columns = (small_from_fine[0, 0] * fine[0] + small_from_fine[0, 2]).astype(np.float32)
    rows = (small_from_fine[1, 1] * fine[1] + small_from_fine[1, 2]).astype(np.float32)
    at_columns, at_rows = np.meshgrid(columns + margin, rows + margin)
    return np.asarray(cv2.remap(blurred, at_columns, at_rows, cv2.INTER_LINEAR), np.float32)


def tinted(gray: Float32Array, tint: tuple[float, float, float]) -> UInt8Array:
    """Return (h, w, 3) uint8 BGR of a gray level, each channel by its own factor."""
    colour = gray[..., None] * np.array(tint, np.float32)
    return np.clip(np.round(colour), 0, 255).astype(np.uint8)
