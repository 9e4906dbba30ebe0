"""The same spots of the floor in two pictures, found to hundredths of a pixel.

Small windows of one picture are looked for in the other near where the motion between them
foretells it: an inverse-compositional Lucas-Kanade alignment (Baker and Matthews, IJCV 56, 2004) of
a shift, on windows of zero mean and equal contrast, from coarse to fine. What a window shows tells
in which direction its shift is known: along a plain line it is not, and the whitening says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array, UInt8Array
from slamcli.stages.adjustment.patch_alignment import (
    HALF_PIXELS,
    Warp,
    align,
    cut,
    evaluate,
    judge,
    slope_of_warp,
    slopes,
)
from slamcli.stages.adjustment.pyramid import MAX_LEVEL, Pyramid

# Weaker gradients, in gray levels a pixel, are the camera's noise.
_MIN_GRADIENT_GRAY = 1.5
# Corners tell both directions; a line's one is worth this share of it.
_LINE_SHARE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Spots of the floor that two frames both see.

    Attributes
    ----------
    a, b : int
        Frame indices.
    pixels_a, pixels_b : (N, 2) float64
        In the frames' own pictures.
    whitening : (N, 2, 2) float64
        Turns an error of `pixels_b` into standard deviations.
    """

    a: int
    b: int
    pixels_a: Float64Array
    pixels_b: Float64Array
    whitening: Float64Array

    def __len__(self) -> int:
        return len(self.pixels_a)


def choose_points(pyramid: Pyramid, seen: UInt8Array, count: int) -> Float64Array:
    """Return up to about `count` (N, 2) pixels that tell most, one in each cell of a raster.

    Parameters
    ----------
    seen : (H, W) uint8
        255 where the other frame sees the same floor.
    """
    usable = cv2.erode(np.minimum(pyramid.masks[0], seen), np.ones((5, 5)))
    area = int(np.count_nonzero(usable == 255))
    cell = max(4, math.ceil(math.sqrt(area / count)))
    right, down = slopes(pyramid.images[0])
    side = (2 * HALF_PIXELS + 1, 2 * HALF_PIXELS + 1)
    xx, yy, xy = (
        np.asarray(cv2.blur(product, side)) for product in (right**2, down**2, right * down)
    )
    middle, spread = (xx + yy) / 2.0, np.hypot((xx - yy) / 2.0, xy)
    telling = np.maximum(middle - spread, 0.0) + _LINE_SHARE * (middle + spread)
    strong = (middle + spread > _MIN_GRADIENT_GRAY**2) & (np.asarray(usable) == 255)
    telling = np.where(strong, telling, 0.0)
    rows, columns = telling.shape[0] // cell, telling.shape[1] // cell
    cells = telling[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    flat = cells.transpose(0, 2, 1, 3).reshape(rows * columns, cell * cell)
    best = np.argmax(flat, axis=1)
    found = flat[np.arange(len(flat)), best] > 0.0
    row, column = np.divmod(np.arange(len(flat)), columns)
    points = np.column_stack([column * cell + best % cell, row * cell + best // cell])
    return np.asarray(points[found], np.float64)


def track(
    first: Pyramid,
    second: Pyramid,
    points: Float64Array,
    second_from_first: Warp,
    coarsest: int = MAX_LEVEL,
) -> tuple[Int64Array, Float64Array, Float64Array]:
    """Find points of one picture in another.

    Parameters
    ----------
    points : (N, 2) float64
        Pixels of the first.
    second_from_first : callable
        Maps (M, 2) pixels as foretold; nan where the other cannot see them.
    coarsest : int
        Level to start at: 0 when the foretold place is within a few pixels, 3 within some 30.

    Returns
    -------
    kept : (K,) int
        Which of the points were found.
    pixels : (K, 2) float64
        Of the second.
    whitening : (K, 2, 2) float64
        Of those.
    """
    shift = np.zeros_like(points)
    alive = np.arange(len(points))
    for level in range(coarsest, 0, -1):
        windows = cut(first, second, points[alive], second_from_first, level)
        good = windows.good
        shift[alive[good]] = align(windows, shift[alive])[good]
        alive = alive[np.isfinite(windows.coefficients).all(axis=(1, 2))]
    windows = cut(first, second, points[alive], second_from_first, 0)
    start = shift[alive]
    found = align(windows, start)
    judged = judge(windows, found)
    good = windows.good & judged.good
    pixels = evaluate(windows.coefficients, found)
    jacobian = slope_of_warp(windows.coefficients, found)
    good &= np.abs(np.linalg.det(jacobian)) > 1e-6
    whitening = judged.whitening[good] @ np.linalg.inv(jacobian[good])
    return alive[good], pixels[good], whitening
