"""Subpixel refinement of corners: the nearest peak of the Laplacian of Gaussian.

ORB's corners lie on whole pixels, and which pixel of a corner wins changes with the view. The peak
of a Laplacian of Gaussian near it is a place in the texture itself, the same from every direction
(Lindeberg, IJCV 30, 1998; it is what SIFT's points are), and a parabola places it to about a tenth
of a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from slamcli.core.arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
)

# Chosen by the error of rigid fits on asphalt-like noise; 1.2 to 2.4 differ by little.
_SIGMA_PIXELS = 2.0
# How far from the corner the peak is searched; the ring around it is for the parabola alone.
_SEARCH_PIXELS = 2
_RESPONSE_RADIUS = _SEARCH_PIXELS + 1
_PATCH_RADIUS = _RESPONSE_RADIUS + math.ceil(3 * _SIGMA_PIXELS)


def refine(
    images: Sequence[UInt8Array], image_of: Int32Array, corners: Int64Array
) -> tuple[Float64Array, BoolArray]:
    """Move corners to the nearest peak of the Laplacian of Gaussian.

    Parameters
    ----------
    images : sequence of (h, w) uint8
    image_of : (N,) int
        The number of each corner's image.
    corners : (N, 2) int, column and row

    Returns
    -------
    refined : (N, 2) float64
        Where no peak is near, or the border is: the corner itself.
    found : (N,) bool
    """
    sizes = np.array([image.shape[::-1] for image in images]).reshape(-1, 2)[image_of]
    inside = np.all((corners >= _PATCH_RADIUS) & (corners < sizes - _PATCH_RADIUS), axis=1)
    refined = corners.astype(np.float64)
    found = np.zeros(len(corners), dtype=np.bool_)
    if inside.any():
        patches = _patches(images, image_of[inside], corners[inside])
        offsets, peaked = _peaks(_laplacian(patches))
        refined[inside] += offsets
        found[inside] = peaked
    return refined, found


def _patches(
    images: Sequence[UInt8Array], image_of: Int32Array, corners: Int64Array
) -> Float32Array:
    """Return (N, r, r): what is around the corners."""
    side = 2 * _PATCH_RADIUS + 1
    patches = np.empty((len(corners), side, side), np.float32)
    for number, image in enumerate(images):
        here = image_of == number
        if here.any():
            windows = np.lib.stride_tricks.sliding_window_view(image, (side, side))
            columns, rows = corners[here].T - _PATCH_RADIUS
            patches[here] = windows[rows, columns]
    return patches


def _laplacian(patches: Float32Array) -> Float32Array:
    """Return (N, r, r) responses around the corners, made positive at each corner itself."""
    smooth, curved = _kernels()
    # Along the rows of all patches at once, then down their columns: two large products.
    side, ring = patches.shape[1], len(smooth)
    along = patches.reshape(-1, side) @ np.vstack([smooth, curved]).T
    stacked = along.reshape(-1, side, 2, ring).transpose(2, 1, 0, 3).reshape(2 * side, -1)
    down = np.hstack([curved, smooth]) @ stacked
    response = np.ascontiguousarray(down.reshape(ring, -1, ring).transpose(1, 0, 2))
    centre = response[:, _RESPONSE_RADIUS, _RESPONSE_RADIUS]
    signed: Float32Array = response * np.sign(centre)[:, None, None]
    return signed


@lru_cache(maxsize=1)
def _kernels() -> tuple[Float32Array, Float32Array]:
    """Return a Gaussian and its second derivative as (response, patch) band matrices."""
    response = np.arange(-_RESPONSE_RADIUS, _RESPONSE_RADIUS + 1)[:, None]
    distance = np.arange(-_PATCH_RADIUS, _PATCH_RADIUS + 1)[None, :] - response
    variance = _SIGMA_PIXELS**2
    smooth = np.exp(-(distance**2) / (2.0 * variance))
    smooth /= smooth.sum(axis=1, keepdims=True)
    curved = smooth * (distance**2 / variance - 1.0) / variance
    # Cut-off tails leave a remainder that would respond to plain brightness.
    curved -= curved.mean(axis=1, keepdims=True)
    return smooth.astype(np.float32), curved.astype(np.float32)


def _peaks(response: Float32Array) -> tuple[Float64Array, BoolArray]:
    """Return the offset (N, 2) of each patch's highest inner response, by a parabola through 3x3.

    The second value, (N,) bool, is where that really is a peak, less than a pixel from its centre.
    """
    count, side = len(response), 2 * _SEARCH_PIXELS + 1
    best = response[:, 1:-1, 1:-1].reshape(count, -1).argmax(axis=1)
    row, column = best // side + 1, best % side + 1
    index = np.arange(count)

    def at(down: int, right: int) -> Float64Array:
        return np.asarray(response[index, row + down, column + right], dtype=np.float64)

    slope_x, slope_y = (at(0, 1) - at(0, -1)) / 2.0, (at(1, 0) - at(-1, 0)) / 2.0
    curve_x = at(0, 1) - 2.0 * at(0, 0) + at(0, -1)
    curve_y = at(1, 0) - 2.0 * at(0, 0) + at(-1, 0)
    twist = (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)) / 4.0
    determinant = curve_x * curve_y - twist * twist
    peaked = (determinant > 0) & (curve_x < 0)
    divisor = np.where(peaked, determinant, 1.0)
    shift_x = (twist * slope_y - curve_y * slope_x) / divisor
    shift_y = (twist * slope_x - curve_x * slope_y) / divisor
    peaked &= (np.abs(shift_x) < 1.0) & (np.abs(shift_y) < 1.0)
    offsets = np.column_stack(
        [column - _RESPONSE_RADIUS + shift_x, row - _RESPONSE_RADIUS + shift_y]
    )
    return np.where(peaked[:, None], offsets, 0.0), peaked
