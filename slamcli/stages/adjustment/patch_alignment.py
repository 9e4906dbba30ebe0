"""Inverse-compositional Lucas-Kanade alignment of small patches of one image to another.

Each patch has one unknown shift (Baker and Matthews, IJCV 56, 2004), and is compared at zero mean
and equal contrast. Where the other image is read is a quadratic in the shift.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from slamcli.stages.adjustment.pyramid import Pyramid

Warp = Callable[[Float64Array], Float64Array]

# [All thresholds here are guarded by benchmarks/self_calibration.py.]
HALF_PIXELS = 7
_MAX_ITERATIONS = 10
_CONVERGED_PIXELS = 0.01
_DAMPING_SHARE = 0.003
_MIN_CORRELATION = 0.75
_MIN_SHARE_SEEN = 0.5
# Residuals of neighbouring pixels are correlated, by the smoothing and by JPEG compression: only
# one pixel in this many counts as independent.
_CORRELATED_PIXELS = 6.0
_MIN_SIGMA_PIXELS = 0.03
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
    gradients : (N, W, 2) float32
        Per pixel of the level.
    inside : (N, W) float32
        1 where the first image shows usable floor.
    coefficients : (N, 6, 2) float64
        Where the second is read, in its full-size pixels, as a quadratic in the shift from the
        patch's centre, full-size pixels of the first.
    readings : tuple of _LevelReading
    good : (N,) bool
        Whether enough of the patch shows usable floor.
    """

    level: int
    values: Float32Array
    gradients: Float32Array
    inside: Float32Array
    coefficients: Float64Array
    readings: tuple[_LevelReading, ...]
    good: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _LevelReading:
    """Where patches are read from one level of the second image.

    Attributes
    ----------
    chosen : (M,) int
        Indices of the patches.
    image : (h, w) float32
    mask : (h, w) uint8
    pixels : (M, W, 2) float32
        Of that level, without a shift.
    by_shift : (M, W, 2, 2) float32
        Their derivative by the shift; the second derivative is in `coefficients`.
    scale : float
        Pixels of the level to one of the full-size image.
    """

    chosen: Int64Array
    image: Float32Array
    mask: UInt8Array
    pixels: Float32Array
    by_shift: Float32Array
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class PatchQuality:
    """Which patches are matches (N,), and the whitening (N, 2, 2) of their shifts."""

    good: BoolArray
    whitening: Float64Array


def cut_patches(
    first: Pyramid,
    second: Pyramid,
    points: Float64Array,
    second_from_first: Warp,
    level: int,
) -> Patches:
    """Return patches about (N, 2) pixels of the first image, and where the second is read."""
    size = 2.0**level
    pixels = points[:, None] / size + _offsets()
    image = first.images[level]
    right, down = image_gradients(image)
    values = _sample(image, pixels)
    gradients = np.stack([_sample(right, pixels), _sample(down, pixels)], axis=2)
    inside = (_sample(first.masks[level], pixels) > 254.5).astype(np.float32)
    weight = np.maximum(inside.sum(axis=1, keepdims=True), 1.0)
    values = (values - (values * inside).sum(axis=1, keepdims=True) / weight) * inside
    mean = (gradients * inside[:, :, None]).sum(axis=1, keepdims=True) / weight[:, :, None]
    gradients = (gradients - mean) * inside[:, :, None]
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
    good = known & (inside.mean(axis=1) >= _MIN_SHARE_SEEN)
    return Patches(level, values, gradients, inside, coefficients, readings, good)


def align_patches(patches: Patches, start: Float64Array) -> Float64Array:
    """Return (N, 2) shifts, full-size pixels of the first image; the start where they diverge."""
    size = 2.0**patches.level
    shift = start.copy()
    information = np.einsum("nwi,nwj->nij", patches.gradients, patches.gradients)
    largest = np.trace(information, axis1=1, axis2=2)
    damped = information + (_DAMPING_SHARE * largest + 1e-6)[:, None, None] * np.eye(2)
    inverse = np.linalg.inv(damped)
    for _ in range(_MAX_ITERATIONS):
        residual, _, _ = _residual(patches, shift)
        gradient = np.einsum("nwi,nw->ni", patches.gradients, residual)
        step = np.einsum("nij,nj->ni", inverse, gradient)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, HALF_PIXELS / 2 / np.maximum(length, 1e-9))
        # A step of the template one way is a step of where it is read the other way.
        shift -= step * size
        if not np.any(length[patches.good] > _CONVERGED_PIXELS):
            break
    moved = np.linalg.norm(shift - start, axis=1)
    diverged = ~(moved < HALF_PIXELS * size)
    shift[diverged] = start[diverged]
    return shift


def patch_quality(patches: Patches, shift: Float64Array) -> PatchQuality:
    """Return which shifted patches are matches, and how well each one's shift is known."""
    residual, correlation, weight = _residual(patches, shift)
    share = weight.mean(axis=1)
    noise = (residual**2).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0)
    gradients = patches.gradients * weight[:, :, None]
    information = np.einsum("nwi,nwj->nij", gradients, gradients)
    information /= np.maximum(noise, 0.25)[:, None, None] * _CORRELATED_PIXELS
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 0.0)
    values /= 1.0 + values * _MIN_SIGMA_PIXELS**2
    whitening = np.sqrt(values)[:, :, None] * vectors.transpose(0, 2, 1)
    good = (correlation >= _MIN_CORRELATION) & (share >= _MIN_SHARE_SEEN)
    return PatchQuality(good & (values[:, 1] > 1.0), whitening)


def warp_centres(coefficients: Float64Array, shift: Float64Array) -> Float64Array:
    """Return (N, 2): the pixels of the second image at which shifted patches have their centres."""
    return np.asarray(np.einsum("nk,nkd->nd", _basis(shift), coefficients))


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


def _reading(
    second: Pyramid,
    level: int,
    chosen: Int64Array,
    coefficients: Float64Array,
    size: float,
) -> _LevelReading:
    """Return where the chosen patches, of level `log2(size)`, are read from a level."""
    scale = 2.0**-level
    around = _offsets() * size
    x, y = around.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    bases = np.stack(
        [
            _basis(around),
            np.stack([zero, one, zero, 2.0 * x, y, zero], axis=1),
            np.stack([zero, zero, one, zero, x, 2.0 * y], axis=1),
        ]
    )
    pixels, by_x, by_y = (
        (scale * (basis @ coefficients[chosen])).astype(np.float32) for basis in bases
    )
    return _LevelReading(
        chosen,
        second.images[level],
        second.masks[level],
        pixels,
        np.stack([by_x, by_y], axis=3),
        scale,
    )


def _residual(
    patches: Patches, shift: Float64Array
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return second minus first (N, W), of equal contrast; the correlation (N,); the weight."""
    read = np.zeros_like(patches.values)
    weight = np.zeros_like(patches.values)
    for reading in patches.readings:
        chosen = reading.chosen
        moved = shift[chosen].astype(np.float32)
        bend = np.einsum(
            "nk,nkd->nd", _basis(shift[chosen])[:, 3:], patches.coefficients[chosen, 3:]
        )
        pixels = reading.pixels + (reading.by_shift @ moved[:, None, :, None])[..., 0]
        pixels += (reading.scale * bend[:, None]).astype(np.float32)
        read[chosen] = _sample(reading.image, pixels)
        weight[chosen] = _sample(reading.mask, pixels) > 254.5
    weight *= patches.inside
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    read = (read - (read * weight).sum(axis=1, keepdims=True) / total) * weight
    mean = (patches.values * weight).sum(axis=1, keepdims=True) / total
    template = (patches.values - mean) * weight
    energy_read = np.maximum((read**2).sum(axis=1), 1e-6)
    energy = np.maximum((template**2).sum(axis=1), 1e-6)
    gain = np.sqrt(energy / energy_read)[:, None]
    correlation = (read * template).sum(axis=1) / np.sqrt(energy * energy_read)
    return gain * read - template, correlation, weight


def _offsets() -> Float64Array:
    side = np.arange(-HALF_PIXELS, HALF_PIXELS + 1, dtype=np.float64)
    columns, rows = np.meshgrid(side, side)
    return np.column_stack([columns.ravel(), rows.ravel()])


def _fit_warp(points: Float64Array, second_from_first: Warp, reach: float) -> Float64Array:
    """Return (N, 6, 2): the quadratic that fits a warp best at nine points about each point."""
    side = np.array([-1.0, 0.0, 1.0])
    columns, rows = (values.ravel() for values in np.meshgrid(side, side))
    around = np.column_stack([columns, rows]) * reach
    mapped = second_from_first((points[:, None] + around).reshape(-1, 2))
    basis = _basis(around)
    return np.asarray(np.linalg.pinv(basis) @ mapped.reshape(len(points), len(around), 2))


def _basis(shift: Float64Array) -> Float64Array:
    x, y = shift[..., 0], shift[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _sample(image: Float32Array | UInt8Array, pixels: NDArray[np.floating]) -> Float32Array:
    """Interpolate (h, w) at (N, W, 2) pixels; 0 outside."""
    if len(pixels) == 0:
        return np.zeros(pixels.shape[:2], np.float32)
    columns, rows = (np.ascontiguousarray(pixels[..., axis], np.float32) for axis in (0, 1))
    read = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
    return np.asarray(read, np.float32)
