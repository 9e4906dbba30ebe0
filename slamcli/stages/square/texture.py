"""Texture and noise to either side of an edge, as the covariance of the profiles across it.

A floor's mottling is brighter than the noise of a camera by far, and on the lighter side of an edge
it is many times that of the darker one. An edge that is located by weights alike to either side
takes a spot beside it for a part of its step; with this covariance it does not.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from slamcli.core.arrays import Float64Array

_WALK_STEP_PIXELS = 0.1
# Beyond this share of a profile neither the step nor a sharpening mask's overshoot shows.
CLEAR_SHARE = 0.4
_REACH_BLURS = 4.0
_MIN_SAMPLES = 4
_MAX_CORRELATED_PROFILES = 40
_LEAST_CORRELATION = 0.05


def texture_covariance(
    values: Float64Array, offsets: Float64Array, blur_pixels: float
) -> Float64Array:
    """Return (T, T): the covariance of one profile by the texture and the noise of either side.

    A side's light is a random walk that begins at the edge, seen through the blur, with white
    noise on top. How fast it walks is what differences along the profiles show (their variogram).

    Parameters
    ----------
    values : (N, T)
        Profiles, from inside to outside.
    offsets : (T,)
        Positive outwards, pixels.
    blur_pixels : float
        Standard deviation of the blur.
    """
    spacing = float(offsets[1] - offsets[0])
    centred = values - values.mean(axis=0)
    clear = offsets > CLEAR_SHARE * offsets[-1]
    starts = np.arange(0.0, offsets[-1] + _REACH_BLURS * blur_pixels, _WALK_STEP_PIXELS)
    seen = ndtr((offsets[:, None] - starts) / blur_pixels)
    walk = seen @ seen.T * _WALK_STEP_PIXELS
    rate, noise = _walk_and_noise(centred[:, clear], spacing, blur_pixels)
    outside = rate * walk + noise * np.diag(ndtr(offsets / blur_pixels))
    rate, noise = _walk_and_noise(centred[:, ::-1][:, clear], spacing, blur_pixels)
    inside = rate * walk + noise * np.diag(ndtr(offsets / blur_pixels))
    covariance: Float64Array = outside + inside[::-1, ::-1]
    return covariance


def correlated_profiles(values: Float64Array) -> float:
    """Return how many neighbours of (N, T) profiles have the same texture.

    The integrated autocorrelation along the side, cut where it ends.
    """
    centred = values - values.mean(axis=0)
    power = float(np.sum(centred**2))
    total = 1.0
    for lag in range(1, min(_MAX_CORRELATED_PROFILES, len(values) // 3)):
        correlation = float(np.sum(centred[lag:] * centred[:-lag])) / max(power, 1e-12)
        if correlation < _LEAST_CORRELATION:
            break
        total += 2.0 * correlation
    return total


def _walk_and_noise(side: Float64Array, spacing: float, blur_pixels: float) -> tuple[float, float]:
    """Return the variance per pixel of a side's random walk, and that of its white noise."""
    count = side.shape[1]
    if count < _MIN_SAMPLES:
        return 0.0, 0.0
    lags = np.arange(1, count)
    seen = np.array([float(np.mean((side[:, lag:] - side[:, :-lag]) ** 2)) for lag in lags])
    reach = 1.5 * _REACH_BLURS * blur_pixels
    starts = np.arange(-reach, count * spacing + reach, _WALK_STEP_PIXELS)
    between = ndtr((lags[:, None] * spacing - starts) / blur_pixels) - ndtr(-starts / blur_pixels)
    walk = np.sum(between**2, axis=1) * _WALK_STEP_PIXELS
    # Slow to load, and needed only here.
    from scipy.optimize import nnls

    weights = np.sqrt(count - lags) / np.maximum(seen, 1e-9)
    design = np.column_stack([walk, np.full(len(lags), 2.0)])
    (rate, noise), _ = nnls(design * weights[:, None], seen * weights)
    return float(rate), float(noise)
