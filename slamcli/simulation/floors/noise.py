"""Noise that depends on the seed and its position alone, so that blocks meet without a seam."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.geometry import Grid

# White noise is drawn in pieces of this side, to draw few more pixels than a block needs.
_NOISE_PIXELS = 128
# Pieces of 64 KiB that the next blocks need again: of a row of blocks, for all kinds of noise.
_KEPT_PIECES = 1536
# Noise of larger blobs is made at a coarser scale.
_MAX_BLUR_PIXELS, _MAX_QUICK_BLUR_PIXELS = 8.0, 4.0


@dataclass(frozen=True, slots=True)
class Seed:
    """The number that all noise of one kind on a floor is drawn from.

    Attributes
    ----------
    number : int
        Not negative.
    quick : bool
        Drawn and blurred more coarsely, for a fraction of the work: pixels are 8-bit uniform
        numbers, which blur makes all but normal.
    """

    number: int
    quick: bool = False

    def __add__(self, more: int) -> Seed:
        """Return the seed of another kind of noise on the same floor."""
        return Seed(self.number + more, self.quick)

    def generator(self, column: int, row: int) -> np.random.Generator:
        """Return the random numbers of a place, which may lie left of the origin or above it."""
        return np.random.default_rng(self._key(column, row))

    def white(self, column: int, row: int, side: int) -> Float32Array:
        """Return (side, side) pixels of zero mean and unit variance, of a place."""
        if not self.quick:
            return self.generator(column, row).standard_normal((side, side), dtype=np.float32)
        # Its state is small, so that seeding takes less than drawing.
        drawn = np.random.Generator(np.random.SFC64(self._key(column, row))).bytes(side * side)
        white = np.frombuffer(drawn, np.uint8).reshape(side, side).astype(np.float32)
        white -= np.float32(127.5)
        white *= np.float32(math.sqrt(12.0 / 65535.0))
        return white

    def _key(self, column: int, row: int) -> list[int]:
        # Seeds are natural numbers.
        return [self.number, column + 2**31, row + 2**31]


def white_noise(grid: Grid, seed: Seed, margin: int = 0) -> Float32Array:
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
def _white_piece(seed: Seed, row: int, column: int) -> Float32Array:
    return seed.white(row, column, _NOISE_PIXELS)


def smooth_noise(grid: Grid, seed: Seed, sigma_metres: float, stretch: float = 1.0) -> Float32Array:
    """Return (h, w) noise of unit variance with blobs of a size, `stretch` times longer along x.

    Large blobs are made at a coarser scale and enlarged: the same look for a fraction of the work.
    """
    sigma = sigma_metres / grid.metres_per_pixel
    coarse = 1
    while sigma / coarse > (_MAX_QUICK_BLUR_PIXELS if seed.quick else _MAX_BLUR_PIXELS):
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
    if coarse == 1:
        inner = blurred[margin:-margin, margin:-margin]
        return np.ascontiguousarray(inner[: grid.height, : grid.width])
    # One pixel more all round, so that what is kept lies between pixels of the coarse noise.
    inner = blurred[margin - 1 : 1 - margin, margin - 1 : 1 - margin]
    size = inner.shape[1] * coarse, inner.shape[0] * coarse
    fine = cv2.resize(inner, size, interpolation=cv2.INTER_LINEAR)
    inside = fine[coarse : coarse + grid.height, coarse : coarse + grid.width]
    return np.ascontiguousarray(inside, np.float32)


def tinted(gray: Float32Array, tint: tuple[float, float, float]) -> UInt8Array:
    """Return (h, w, 3) uint8 BGR of a gray level, each channel by its own factor."""
    channels = [cv2.convertScaleAbs(np.maximum(gray, 0), alpha=factor) for factor in tint]
    return np.asarray(cv2.merge(channels), np.uint8)
