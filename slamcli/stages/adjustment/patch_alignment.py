"""Inverse-compositional Lucas-Kanade alignment of small patches of one image to another.

Each patch has one unknown shift (Baker and Matthews, IJCV 56, 2004), and is compared at zero mean
and equal contrast. Where the other image is read is a quadratic in the shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.stages.adjustment.patches import (
    HALF_PIXELS,
    MIN_SHARE_SEEN,
    Patches,
    quadratic,
    sample,
)

# [All thresholds here are guarded by benchmarks/self_calibration.py.]
_MAX_ITERATIONS = 10
# A patch is left where its steps are shorter, in pixels of the finest level; on a coarser one, from
# which the next level starts, ten times that is enough.
_CONVERGED_PIXELS, _CONVERGED_COARSE_PIXELS = 0.01, 0.1
_DAMPING_SHARE = 0.003
_MIN_CORRELATION = 0.75
# Residuals of neighbouring pixels are correlated, by the smoothing and by JPEG compression: only
# one pixel in this many counts as independent.
_CORRELATED_PIXELS = 6.0
_MIN_SIGMA_PIXELS = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class PatchQuality:
    """Which patches are matches (N,), and the whitening (N, 2, 2) of their shifts."""

    good: BoolArray
    whitening: Float64Array


def align_patches(patches: Patches, start: Float64Array) -> Float64Array:
    """Return (N, 2) shifts, full-size pixels of the first image; the start where they diverge.

    Only good patches are aligned, and each until its own steps are short.
    """
    size = 2.0**patches.level
    shift = start.copy()
    moving = np.flatnonzero(patches.good)
    current, inverse = patches.take(moving), _inverse_information(patches.gradients[:, moving])
    converged = _CONVERGED_COARSE_PIXELS if patches.level else _CONVERGED_PIXELS
    for _ in range(_MAX_ITERATIONS):
        residual, _, _ = _residual(current, shift[moving])
        gradient = (current.gradients * residual).sum(axis=2, dtype=np.float64)
        step = np.einsum("ijn,jn->ni", inverse, gradient)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1.0, HALF_PIXELS / 2 / np.maximum(length, 1e-9))
        # A step of the template one way is a step of where it is read the other way.
        shift[moving] -= step * size
        still = np.flatnonzero(length[:, 0] > converged)
        if not len(still):
            break
        if len(still) < len(moving):
            moving, inverse = moving[still], inverse[:, :, still]
            current = current.take(still)
    moved = np.linalg.norm(shift - start, axis=1)
    diverged = ~(moved < HALF_PIXELS * size)
    shift[diverged] = start[diverged]
    return shift


def _inverse_information(gradients: Float32Array) -> Float64Array:
    """Return (2, 2, N): the inverses of the patches' structure tensors, damped along lines."""
    information = _information(gradients)
    damping = _DAMPING_SHARE * (information[0, 0] + information[1, 1]) + 1e-6
    damped = information + damping * np.eye(2)[:, :, None]
    return np.ascontiguousarray(np.linalg.inv(damped.T).T)


def _information(gradients: Float32Array) -> Float64Array:
    """Return (2, 2, N): the structure tensor of every patch, from gradients (2, N, W)."""
    right, down = gradients
    xx, xy, yy = (
        (a * b).sum(axis=1, dtype=np.float64)
        for a, b in ((right, right), (right, down), (down, down))
    )
    return np.array([[xx, xy], [xy, yy]])


def patch_quality(patches: Patches, shift: Float64Array) -> PatchQuality:
    """Return which shifted patches are matches, and how well each one's shift is known."""
    residual, correlation, weight = _residual(patches, shift)
    share = weight.mean(axis=1)
    noise = (residual**2).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0)
    information = _information(patches.gradients * weight).T
    information = information / (np.maximum(noise, 0.25)[:, None, None] * _CORRELATED_PIXELS)
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 0.0)
    values /= 1.0 + values * _MIN_SIGMA_PIXELS**2
    whitening = np.sqrt(values)[:, :, None] * vectors.transpose(0, 2, 1)
    good = (correlation >= _MIN_CORRELATION) & (share >= MIN_SHARE_SEEN)
    return PatchQuality(good & (values[:, 1] > 1.0), whitening)


def _residual(
    patches: Patches, shift: Float64Array
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Return second minus first (N, W), of equal contrast; the correlation (N,); the weight."""
    read = np.zeros_like(patches.values)
    weight = np.zeros_like(patches.values)
    for reading in patches.readings:
        chosen = reading.chosen
        right, down = shift[chosen].astype(np.float32).T[:, :, None]
        bend = np.einsum(
            "nk,nkd->dn", quadratic(shift[chosen])[:, 3:], patches.coefficients[chosen, 3:]
        )
        pixels = reading.by_shift[:, 0] * right
        pixels += reading.by_shift[:, 1] * down
        pixels += reading.pixels
        pixels += (reading.scale * bend).astype(np.float32)[:, :, None]
        read[chosen] = sample(reading.image, pixels)
        weight[chosen] = sample(reading.mask, pixels) > 254.5
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
