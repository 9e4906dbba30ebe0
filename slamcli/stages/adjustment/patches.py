"""Patches cut from one image, and where they are read from another one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from slamcli.stages.adjustment.pyramid import Pyramid

Warp = Callable[[Float64Array], Float64Array]

HALF_PIXELS = 7
# Share of a patch that must show usable floor [guarded by benchmarks/self_calibration.py].
MIN_SHARE_SEEN = 0.5
# Where the other image has a resolution higher by more than this, a coarser level of it is read.
_FINER = math.sqrt(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Patches of one pyramid level, ready to be shifted.

    Attributes
    ----------
    level : int
    values : (N, W) float32
        Of the first image, zero mean.
    gradients : (2, N, W) float32
        To the right and down, per pixel of the level.
    inside : (N, W) float32
        1 where the first image shows usable floor.
    coefficients : (N, 6, 2) float64
        Where the second is read, in its full-size pixels, as a quadratic in the shift from the
        patch's centre, full-size pixels of the first.
    readings : tuple of LevelReading
    good : (N,) bool
        Whether enough of the patch shows usable floor.
    """

    level: int
    values: Float32Array
    gradients: Float32Array
    inside: Float32Array
    coefficients: Float64Array
    readings: tuple[LevelReading, ...]
    good: BoolArray

    def take(self, numbers: Int64Array) -> Patches:
        """Return some of the patches, by their ascending numbers."""
        return Patches(
            self.level,
            self.values[numbers],
            self.gradients[:, numbers],
            self.inside[numbers],
            self.coefficients[numbers],
            tuple(reading.take(numbers) for reading in self.readings),
            self.good[numbers],
        )


@dataclass(frozen=True, slots=True, eq=False)
class LevelReading:
    """Where patches are read from one level of the second image.

    Attributes
    ----------
    chosen : (M,) int
        Indices of the patches, ascending.
    image : (h, w) float32
    mask : (h, w) uint8
    pixels : (2, M, W) float32
        Columns and rows of that level, without a shift.
    by_shift : (2, 2, M, W) float32
        Derivatives by the shift right and down, of either; the second are in `coefficients`.
    scale : float
        Pixels of the level to one of the full-size image.
    """

    chosen: Int64Array
    image: Float32Array
    mask: UInt8Array
    pixels: Float32Array
    by_shift: Float32Array
    scale: float

    def take(self, numbers: Int64Array) -> LevelReading:
        """Return the reading of some of the patches, by their ascending numbers."""
        _, mine, chosen = np.intersect1d(
            self.chosen, numbers, assume_unique=True, return_indices=True
        )
        return replace(
            self,
            chosen=chosen,
            pixels=self.pixels[:, mine],
            by_shift=self.by_shift[:, :, mine],
        )


def cut_patches(
    first: Pyramid,
    second: Pyramid,
    points: Float64Array,
    second_from_first: Warp,
    level: int,
) -> Patches:
    """Return patches about (N, 2) pixels of the first image, and where the second is read."""
    size = 2.0**level
    pixels = (points.T[:, :, None] / size + _offsets().T[:, None]).astype(np.float32)
    values, gradients = _cut(first.images[level], points / size)
    inside = (sample(first.masks[level], pixels) > 254.5).astype(np.float32)
    weight = np.maximum(inside.sum(axis=1, keepdims=True), 1.0)
    values = (values - (values * inside).sum(axis=1, keepdims=True) / weight) * inside
    mean = (gradients * inside).sum(axis=2, keepdims=True) / weight
    gradients = (gradients - mean) * inside
    coefficients = _fit_warp(points, second_from_first, HALF_PIXELS * size)
    known = np.isfinite(coefficients).all(axis=(1, 2))
    scale = np.ones(len(points))
    jacobian = warp_jacobian(coefficients[known], np.zeros((int(known.sum()), 2)))
    scale[known] = np.sqrt(np.abs(np.linalg.det(jacobian)))
    finer = np.floor(np.log2(np.maximum(scale * _FINER, 1.0))).astype(np.int64)
    read = np.minimum(level + finer, len(second.images) - 1)
    readings = tuple(
        _reading(second, int(number), np.flatnonzero(known & (read == number)), coefficients, size)
        for number in np.unique(read[known])
    )
    good = known & (inside.mean(axis=1) >= MIN_SHARE_SEEN)
    return Patches(level, values, gradients, inside, coefficients, readings, good)


def warp_centres(coefficients: Float64Array, shift: Float64Array) -> Float64Array:
    """Return (N, 2): the pixels of the second image at which shifted patches have their centres."""
    return np.asarray(np.einsum("nk,nkd->nd", quadratic(shift), coefficients))


def warp_jacobian(coefficients: Float64Array, shift: Float64Array) -> Float64Array:
    """Return (N, 2, 2): the derivative of `warp_centres` by the shift."""
    x, y = shift[:, 0, None], shift[:, 1, None]
    by_x = coefficients[:, 1] + 2.0 * x * coefficients[:, 3] + y * coefficients[:, 4]
    by_y = coefficients[:, 2] + x * coefficients[:, 4] + 2.0 * y * coefficients[:, 5]
    return np.stack([by_x, by_y], axis=2)


def image_gradients(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the gradients (h, w) of an image to the right and down, in gray levels per pixel."""
    # Scharr's kernel sums to 16, over a span of two pixels.
    right = cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1.0 / 32.0)
    down = cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1.0 / 32.0)
    return np.asarray(right, np.float32), np.asarray(down, np.float32)


def _cut(image: Float32Array, points: Float64Array) -> tuple[Float32Array, Float32Array]:
    """Return patches (N, W) about (N, 2) pixels, and their gradients (2, N, W).

    As wide a patch as the gradients need is interpolated, and differentiated: what they would be
    interpolated in those of the whole image, of which the patches are a small part.
    """
    half, count = HALF_PIXELS + 1, len(points)
    side = 2 * half + 1
    pixels = points.T[:, :, None] + _offsets(half).T[:, None]
    columns, rows = pixels.astype(np.float32).reshape(2, count * side, side)
    if not count:
        return np.zeros((0, (side - 2) ** 2), np.float32), np.zeros(
            (2, 0, (side - 2) ** 2), np.float32
        )
    wide = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    inner = [
        np.asarray(one, np.float32).reshape(count, side, side)[:, 1:-1, 1:-1].reshape(count, -1)
        for one in (wide, *image_gradients(np.asarray(wide, np.float32)))
    ]
    return inner[0], np.stack(inner[1:])


def _reading(
    second: Pyramid,
    level: int,
    chosen: Int64Array,
    coefficients: Float64Array,
    size: float,
) -> LevelReading:
    """Return where the chosen patches, of level `log2(size)`, are read from a level."""
    scale = 2.0**-level
    around = _offsets() * size
    x, y = around.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    bases = np.stack(
        [
            quadratic(around),
            np.stack([zero, one, zero, 2.0 * x, y, zero], axis=1),
            np.stack([zero, zero, one, zero, x, 2.0 * y], axis=1),
        ]
    )
    pixels, by_x, by_y = (
        (scale * (basis @ coefficients[chosen])).astype(np.float32).transpose(2, 0, 1)
        for basis in bases
    )
    return LevelReading(
        chosen,
        second.images[level],
        second.masks[level],
        np.ascontiguousarray(pixels),
        np.stack([by_x, by_y], axis=1),
        scale,
    )


def _offsets(half: int = HALF_PIXELS) -> Float64Array:
    side = np.arange(-half, half + 1, dtype=np.float64)
    columns, rows = np.meshgrid(side, side)
    return np.column_stack([columns.ravel(), rows.ravel()])


def _fit_warp(points: Float64Array, second_from_first: Warp, reach: float) -> Float64Array:
    """Return (N, 6, 2): the quadratic that fits a warp best at nine points about each point."""
    side = np.array([-1.0, 0.0, 1.0])
    columns, rows = (values.ravel() for values in np.meshgrid(side, side))
    around = np.column_stack([columns, rows]) * reach
    mapped = second_from_first((points[:, None] + around).reshape(-1, 2))
    basis = quadratic(around)
    return np.asarray(np.linalg.pinv(basis) @ mapped.reshape(len(points), len(around), 2))


def quadratic(shift: Float64Array) -> Float64Array:
    """Return (..., 6): the terms of a quadratic in shifts (..., 2)."""
    x, y = shift[..., 0], shift[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def sample(image: Float32Array | UInt8Array, pixels: Float32Array) -> Float32Array:
    """Interpolate (h, w) at (N, W) pixels, given as (2, N, W) columns and rows; 0 outside."""
    if pixels.size == 0:
        return np.zeros(pixels.shape[1:], np.float32)
    return np.asarray(cv2.remap(image, pixels[0], pixels[1], cv2.INTER_LINEAR), np.float32)
