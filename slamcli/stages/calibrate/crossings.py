"""Crossings of a chessboard, placed by a model of the light around each.

Four fields meet in a crossing, two light and two dark ones; the light about it is even, but for the
sign, under half a turn. So blur, and the width by which white outgrows black (bloom), leave it
unmoved, and a camera's sharpening too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.geometry import invert

# Part of the fields about a crossing that is used: farther out lie the next crossings.
_WINDOW_FIELDS = 0.45
_ROUNDS = 8
_CONVERGED_PIXELS = 1e-3
_BLURS_PIXELS = (0.4, 0.55, 0.75, 1.0, 1.4, 2.0, 2.8, 4.0)
_COMPARED_CROSSINGS = 12
# Error of a crossing that its residuals do not show: print and paper, demosaicking, one sigma. A
# print that is less exact shows it in the misfit of the whole board
# [benchmarks/calibration_targets.py: NEES].
_SYSTEMATIC_PIXELS = 0.005
# Residuals of neighbouring pixels err alike: blur, demosaicking, interpolation.
_CORRELATED_PIXELS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """The light about one crossing: pixels as (N, 2) fields away from it are `inverse @ pixel`."""

    pixels: Float64Array
    light: Float64Array
    inverse: Float64Array
    distances: Float64Array


def refine_crossings(light: Float32Array, grid: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return crossings where the picture shows them, and their covariances.

    Parameters
    ----------
    light : (H, W) float32
    grid : (rows, columns, 2) float64
        Within a quarter of a field.

    Returns
    -------
    grid : (rows, columns, 2) float64
        Crossings that could not be fitted stay where they were.
    covariances : (rows, columns, 2, 2) float64
        Pixels squared.
    """
    steps = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=-1)
    places = grid.reshape(-1, 2).copy()
    axes = steps.reshape(-1, 2, 2)
    blur = _measure_blur(light, places, axes)
    covariances = np.empty((len(places), 2, 2))
    for index, (place, pair) in enumerate(zip(places, axes, strict=True)):
        found, covariance, _ = _refine(light, place, pair, blur)
        # A crossing that leaves its fields has none: reflections, a torn print.
        field = float(np.linalg.norm(pair, axis=0).min())
        if float(np.linalg.norm(found - place)) < 0.3 * field:
            places[index], covariances[index] = found, covariance
        else:
            covariances[index] = np.eye(2) * field**2
    return places.reshape(grid.shape), covariances.reshape(*grid.shape, 2)


def _measure_blur(light: Float32Array, places: Float64Array, axes: Float64Array) -> float:
    """Return the blur, pixels, that explains some of the crossings best."""
    chosen = np.linspace(0, len(places) - 1, min(len(places), _COMPARED_CROSSINGS)).astype(int)
    misfits = [
        sum(_refine(light, places[index], axes[index], blur)[2] for index in chosen)
        for blur in _BLURS_PIXELS
    ]
    return _BLURS_PIXELS[int(np.argmin(misfits))]


def _refine(
    light: Float32Array, start: Float64Array, axes: Float64Array, blur: float
) -> tuple[Float64Array, Float64Array, float]:
    """Return a crossing, its (2, 2) covariance and the mean squared residual."""
    place = start
    for _ in range(_ROUNDS):
        window = _read(light, place, axes)
        model = _model(window, blur)
        if len(window.light) <= model.shape[1]:
            return start + np.inf, np.eye(2), np.inf
        inverse = np.linalg.pinv(model)
        values = inverse @ window.light
        contrast = float(values[0])
        if abs(contrast) < 1e-3:
            return start + np.inf, np.eye(2), np.inf
        change = values[1:3] / contrast
        place = place + np.clip(change, -1.0, 1.0)
        if float(np.abs(change).max()) < _CONVERGED_PIXELS:
            break
    left = window.light - model @ values
    variance = float(left @ left) / (len(left) - model.shape[1])
    spread = inverse[1:3] @ inverse[1:3].T * (_CORRELATED_PIXELS**2 * variance / contrast**2)
    return place, spread + np.eye(2) * _SYSTEMATIC_PIXELS**2, variance


def _read(light: Float32Array, place: Float64Array, axes: Float64Array) -> _Window:
    height, width = light.shape
    reach = _WINDOW_FIELDS * np.abs(axes).sum(axis=1)
    low = np.maximum(np.ceil(place - reach), 0).astype(int)
    high = np.minimum(np.floor(place + reach), (width - 1, height - 1)).astype(int)
    columns, rows = np.meshgrid(
        np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1), indexing="xy"
    )
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    inverse = invert(axes)
    fields = (pixels - place) @ inverse.T
    inside = np.all(np.abs(fields) < _WINDOW_FIELDS, axis=1)
    lengths = np.linalg.norm(inverse, axis=1)
    values = light[rows.ravel()[inside], columns.ravel()[inside]].astype(np.float64)
    return _Window(pixels[inside] - place, values, inverse, fields[inside] / lengths)


def _model(window: _Window, blur: float) -> Float64Array:
    """Return (N, 6) columns: the crossing, its derivatives by place, and a plane of light."""
    sign = 2.0 * ndtr(window.distances / blur) - 1.0
    density = np.exp(-0.5 * (window.distances / blur) ** 2) * (2.0 / (blur * math.sqrt(math.tau)))
    normals = window.inverse / np.linalg.norm(window.inverse, axis=1)[:, None]
    by_first = density[:, 0] * sign[:, 1]
    by_second = density[:, 1] * sign[:, 0]
    moved = -(by_first[:, None] * normals[0] + by_second[:, None] * normals[1])
    plane = np.column_stack([np.ones(len(sign)), window.pixels])
    return np.column_stack([sign.prod(axis=1), moved, plane])
