"""Local correlation: the similarity of two pictures under a transform, in small windows.

One correlation over a whole overlap is high for any two photographs with a bright sky above a
dark ground, and low where half of it is an empty canvas. The median over small windows, each
with its own mean and contrast, is neither.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.records import View

# Of the compared raster; coarse enough to tolerate a pixel of misfit or of blur
# [guarded by tests/run/match/test_appendix_a.py].
_MAX_PIXELS = 250_000
_WINDOW_PIXELS = 17
# Windows with less contrast are left out; with fewer windows there is no result
# [guarded by tests/run/match/test_appendix_a.py].
_MIN_DEVIATION_GRAY = 4.0
_MIN_WINDOWS = 6
# Fine detail depends on the sharpness of either picture.
_SMOOTHING_PIXELS = 1.2


def local_correlation(view_a: View, view_b: View, a_from_b: Float64Array) -> float:
    """Return the median normalised cross-correlation of small windows of the overlap.

    Parameters
    ----------
    view_a, view_b : View
        Gray; they may differ in resolution.
    a_from_b : (3, 3) float64
        Metres to metres.

    Returns
    -------
    float in [-1, 1]
        Nan when fewer than six windows have contrast in both.
    """
    # The comparison is made at the coarser of the two resolutions, so that neither is enlarged.
    area_scale = math.sqrt(abs(float(np.linalg.det(a_from_b[:2, :2]))))
    finest = max(view_a.grid.metres_per_pixel, area_scale * view_b.grid.metres_per_pixel)
    grid = view_a.grid
    area = grid.width * grid.height * (grid.metres_per_pixel / finest) ** 2
    pixel = finest * max(1.0, math.sqrt(area / _MAX_PIXELS))
    size = (
        max(1, math.ceil(grid.width * grid.metres_per_pixel / pixel)),
        max(1, math.ceil(grid.height * grid.metres_per_pixel / pixel)),
    )
    common = type(grid)(grid.x_min, grid.y_max, pixel, *size)
    first, first_seen = _resample(view_a, common.pixel_from_metres, size, pixel)
    second, second_seen = _resample(
        view_b, common.pixel_from_metres @ a_from_b, size, pixel / area_scale
    )
    return _median_of_windows(first, second, first_seen * second_seen)


def _resample(
    view: View, common_from_metres: Float64Array, size: tuple[int, int], pixel: float
) -> tuple[Float32Array, Float32Array]:
    """Return a view and its mask (0 or 1) on the common raster, low-passed to its resolution."""
    image = view.image.astype(np.float32)
    coarser = pixel / view.grid.metres_per_pixel
    if coarser > 1.0:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.5 * coarser), np.float32)
    homography = common_from_metres @ view.grid.metres_from_pixel
    warped = np.asarray(cv2.warpPerspective(image, homography, size, flags=cv2.INTER_LINEAR))
    mask = np.asarray(cv2.warpPerspective(view.mask, homography, size, flags=cv2.INTER_LINEAR))
    smooth = cv2.GaussianBlur(warped, (0, 0), _SMOOTHING_PIXELS)
    return np.asarray(smooth, np.float32), (mask == 255).astype(np.float32)


def _median_of_windows(first: Float32Array, second: Float32Array, seen: Float32Array) -> float:
    side = (_WINDOW_PIXELS, _WINDOW_PIXELS)

    def mean(values: Float64Array) -> Float64Array:
        return np.asarray(cv2.blur(values, side, borderType=cv2.BORDER_CONSTANT), np.float64)

    whole = mean(seen.astype(np.float64)) > 0.999
    a, b = first.astype(np.float64), second.astype(np.float64)
    mean_a, mean_b = mean(a), mean(b)
    variance_a = np.maximum(mean(a * a) - mean_a**2, 0.0)
    variance_b = np.maximum(mean(b * b) - mean_b**2, 0.0)
    contrast = np.sqrt(np.minimum(variance_a, variance_b))
    step = _WINDOW_PIXELS // 2
    chosen = np.zeros_like(whole)
    chosen[::step, ::step] = True
    chosen &= whole & (contrast > _MIN_DEVIATION_GRAY)
    if np.count_nonzero(chosen) < _MIN_WINDOWS:
        return math.nan
    covariance = (mean(a * b) - mean_a * mean_b)[chosen]
    correlation = covariance / np.sqrt(variance_a[chosen] * variance_b[chosen])
    return float(np.median(correlation))
