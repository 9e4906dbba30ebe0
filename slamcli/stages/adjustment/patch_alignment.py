"""Small windows of one picture shifted until they fit another.

An inverse-compositional Lucas-Kanade alignment (Baker and Matthews, IJCV 56, 2004) of a shift, on
windows of zero mean and equal contrast. Where a window is read is a quadratic in its shift.
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

HALF_PIXELS = 7
_MAX_ITERATIONS = 10
_CONVERGED_PIXELS = 0.01
_DAMPING_SHARE = 0.003
_MIN_CORRELATION = 0.75
_MIN_SHARE_SEEN = 0.5
# Neighbouring pixels' residuals are alike, by the smoothing and by what the picture was stored as.
_CORRELATED_PIXELS = 6.0
_MIN_SIGMA_PIXELS = 0.03
# Where the other picture is finer by more than this, a coarser level of it is read.
_FINER = math.sqrt(2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Windows of one level, ready to be shifted.

    Attributes
    ----------
    level : int
    values : (N, W) float32
        Of the first picture, zero mean.
    gradients : (N, W, 2) float32
        Per pixel of the level.
    inside : (N, W) float32
        1 where the first picture shows usable floor.
    coefficients : (N, 6, 2) float64
        Where the second is read, in its full-size pixels, as a quadratic in the shift from the
        window's middle, full-size pixels of the first.
    readings : tuple of _Reading
    good : (N,) bool
    """

    level: int
    values: Float32Array
    gradients: Float32Array
    inside: Float32Array
    coefficients: Float64Array
    readings: tuple[_Reading, ...]
    good: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _Reading:
    """Windows that are read from one level of the second picture.

    Attributes
    ----------
    chosen : (M,) int
        Which.
    image : (h, w) float32
    mask : (h, w) uint8
    places : (M, W, 2) float32
        Pixels of that level, without a shift.
    by_shift : (M, W, 2, 2) float32
        How they move with it; what it adds to that is in `coefficients`.
    scale : float
        Pixels of the level to one of the full-size picture.
    """

    chosen: Int64Array
    image: Float32Array
    mask: UInt8Array
    places: Float32Array
    by_shift: Float32Array
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Which windows fit (N,), and the whitening (N, 2, 2) of their shifts."""

    good: BoolArray
    whitening: Float64Array


def cut(
    first: Pyramid,
    second: Pyramid,
    points: Float64Array,
    second_from_first: Warp,
    level: int,
) -> Windows:
    """Cut windows about (N, 2) pixels of the first picture, and tell where the second is read."""
    size = 2.0**level
    places = points[:, None] / size + _offsets()
    image = first.images[level]
    right, down = slopes(image)
    values = _sample(image, places)
    gradients = np.stack([_sample(right, places), _sample(down, places)], axis=2)
    inside = (_sample(first.masks[level], places) > 254.5).astype(np.float32)
    weight = np.maximum(inside.sum(axis=1, keepdims=True), 1.0)
    values = (values - (values * inside).sum(axis=1, keepdims=True) / weight) * inside
    mean = (gradients * inside[:, :, None]).sum(axis=1, keepdims=True) / weight[:, :, None]
    gradients = (gradients - mean) * inside[:, :, None]
    coefficients = _fit_warp(points, second_from_first, HALF_PIXELS * size)
    known = np.isfinite(coefficients).all(axis=(1, 2))
    scale = np.ones(len(points))
    slope = slope_of_warp(coefficients[known], np.zeros((int(known.sum()), 2)))
    scale[known] = np.sqrt(np.abs(np.linalg.det(slope)))
    finer = np.floor(np.log2(np.maximum(scale * _FINER, 1.0))).astype(np.int64)
    read = np.minimum(level + finer, len(second.images) - 1)
    readings = tuple(
        _reading(second, int(number), np.flatnonzero(known & (read == number)), coefficients, size)
        for number in np.unique(read[known])
    )
    good = known & (inside.mean(axis=1) >= _MIN_SHARE_SEEN)
    return Windows(level, values, gradients, inside, coefficients, readings, good)


def align(windows: Windows, start: Float64Array) -> Float64Array:
    """Return (N, 2) shifts, full-size pixels of the first; the start where none is found."""
    size = 2.0**windows.level
    shift = start.copy()
    information = np.einsum("nwi,nwj->nij", windows.gradients, windows.gradients)
    largest = np.trace(information, axis1=1, axis2=2)
    damped = information + (_DAMPING_SHARE * largest + 1e-6)[:, None, None] * np.eye(2)
    inverse = np.linalg.inv(damped)
    for _ in range(_MAX_ITERATIONS):
        residual, _, _ = _residual(windows, shift)
        gradient = np.einsum("nwi,nw->ni", windows.gradients, residual)
        step = np.einsum("nij,nj->ni", inverse, gradient)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, HALF_PIXELS / 2 / np.maximum(length, 1e-9))
        # A step of the template one way is a step of the reading the other.
        shift -= step * size
        if not np.any(length[windows.good] > _CONVERGED_PIXELS):
            break
    moved = np.linalg.norm(shift - start, axis=1)
    lost = ~(moved < HALF_PIXELS * size)
    shift[lost] = start[lost]
    return shift


def judge(windows: Windows, shift: Float64Array) -> Judged:
    """Tell which shifted windows are matches, and how well each one's shift is known."""
    residual, correlation, weight = _residual(windows, shift)
    share = weight.mean(axis=1)
    noise = (residual**2).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0)
    gradients = windows.gradients * weight[:, :, None]
    information = np.einsum("nwi,nwj->nij", gradients, gradients)
    information /= np.maximum(noise, 0.25)[:, None, None] * _CORRELATED_PIXELS
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 0.0)
    values /= 1.0 + values * _MIN_SIGMA_PIXELS**2
    whitening = np.sqrt(values)[:, :, None] * vectors.transpose(0, 2, 1)
    good = (correlation >= _MIN_CORRELATION) & (share >= _MIN_SHARE_SEEN)
    return Judged(good & (values[:, 1] > 1.0), whitening)


def evaluate(coefficients: Float64Array, shift: Float64Array) -> Float64Array:
    """Return (N, 2): the pixels of the second picture that are read at a shift."""
    return np.asarray(np.einsum("nk,nkd->nd", _basis(shift), coefficients))


def slope_of_warp(coefficients: Float64Array, shift: Float64Array) -> Float64Array:
    """Return (N, 2, 2): how the place read changes with the shift."""
    x, y = shift[:, 0, None], shift[:, 1, None]
    by_x = coefficients[:, 1] + 2.0 * x * coefficients[:, 3] + y * coefficients[:, 4]
    by_y = coefficients[:, 2] + x * coefficients[:, 4] + 2.0 * y * coefficients[:, 5]
    return np.stack([by_x, by_y], axis=2)


def slopes(image: Float32Array) -> tuple[Float32Array, Float32Array]:
    """Return the slopes (h, w) of a picture to the right and down, in gray levels a pixel."""
    # Scharr's kernel sums to 32 over a span of two pixels' worth of slope.
    right = cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1.0 / 32.0)
    down = cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=1.0 / 32.0)
    return np.asarray(right, np.float32), np.asarray(down, np.float32)


def _reading(
    second: Pyramid,
    level: int,
    chosen: Int64Array,
    coefficients: Float64Array,
    size: float,
) -> _Reading:
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
    places, by_x, by_y = (
        (scale * (basis @ coefficients[chosen])).astype(np.float32) for basis in bases
    )
    return _Reading(
        chosen,
        second.images[level],
        second.masks[level],
        places,
        np.stack([by_x, by_y], axis=3),
        scale,
    )


def _residual(
    windows: Windows, shift: Float64Array
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return second minus first (N, W), of equal contrast; the correlation (N,); the weight."""
    read = np.zeros_like(windows.values)
    weight = np.zeros_like(windows.values)
    for reading in windows.readings:
        chosen = reading.chosen
        moved = shift[chosen].astype(np.float32)
        bend = np.einsum(
            "nk,nkd->nd", _basis(shift[chosen])[:, 3:], windows.coefficients[chosen, 3:]
        )
        places = reading.places + (reading.by_shift @ moved[:, None, :, None])[..., 0]
        places += (reading.scale * bend[:, None]).astype(np.float32)
        read[chosen] = _sample(reading.image, places)
        weight[chosen] = _sample(reading.mask, places) > 254.5
    weight *= windows.inside
    total = np.maximum(weight.sum(axis=1, keepdims=True), 1.0)
    read = (read - (read * weight).sum(axis=1, keepdims=True) / total) * weight
    mean = (windows.values * weight).sum(axis=1, keepdims=True) / total
    template = (windows.values - mean) * weight
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
    """Return (N, 6, 2): a quadratic through where nine places about each point are foretold."""
    side = np.array([-1.0, 0.0, 1.0])
    columns, rows = (values.ravel() for values in np.meshgrid(side, side))
    around = np.column_stack([columns, rows]) * reach
    mapped = second_from_first((points[:, None] + around).reshape(-1, 2))
    basis = _basis(around)
    return np.asarray(np.linalg.pinv(basis) @ mapped.reshape(len(points), len(around), 2))


def _basis(places: Float64Array) -> Float64Array:
    x, y = places[..., 0], places[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def _sample(image: Float32Array | UInt8Array, places: NDArray[np.floating]) -> Float32Array:
    """Interpolate (h, w) at (N, W, 2) pixels; 0 outside."""
    if len(places) == 0:
        return np.zeros(places.shape[:2], np.float32)
    columns, rows = (np.ascontiguousarray(places[..., axis], np.float32) for axis in (0, 1))
    read = cv2.remap(image, columns, rows, cv2.INTER_LINEAR)
    return np.asarray(read, np.float32)
