"""A view's pyramid, each level ready to be compared pixel by pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from slamcli.core.geometry import Grid, apply_homography, invert
from slamcli.core.records import PyramidLevel, View
from slamcli.core.robust import NORMAL_MEDIAN

# From half the view's resolution on, which already resolves hundredths of a pixel, down to where a
# search over every rotation and translation costs some tens of milliseconds.
_MIN_LEVELS = 2
_MAX_LEVELS = 6
_MAX_COARSEST_PIXELS = 20_000
_MAX_TEMPLATE_PIXELS = 15_000
_HIGH_PASS_SIZE = (25, 25)
_MIN_WINDOW_SHARE = 0.7
_SAMPLE_STEP = 16
_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_CONTRAST_PIXELS = 5.0
# What is flatter than this is noise; its contrast is not to be raised to that of a line. It is not
# measured by the picture's own contrast, which may be that of a dark thing on a pale floor.
_MIN_CONTRAST_GRAY = 1.0
_NOISE_TIMES = 3.0
# White noise, halved once and smoothed as the detail is, leaves its deviation over 1.57; the median
# of its size is 0.6745 deviations. Halving it again leaves 0.48 of it.
_NOISE_FACTOR = 1.57 / NORMAL_MEDIAN
_HALVED_NOISE = 0.48
# pyrDown keeps even pixels, so a level's pixel is half the one before's.
_HALVE = np.diag([0.5, 0.5, 1.0])
# So much is added first, as the noise of the dark would else be all there is to see.
_DARK_GRAY = 16.0
_REMAP_COLUMNS = 256
# In gray levels at the middle of the range.
_LOGARITHM = ((128.0 + _DARK_GRAY) * np.log(np.arange(256) + _DARK_GRAY)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class LevelMask:
    """What a level of every view needs to know of where floor is seen; the same for all frames.

    Attributes
    ----------
    mask : (h, w) uint8
        255 where all of a pixel was seen.
    seen : (h, w) float32
        1 there, else 0.
    share : (h, w) float32
        Of the high-pass's window about a pixel that was seen, and not less than a little.
    inside : (h, w) uint8
        255 where the detail and its gradient are free of the mask's border.
    weight : (h, w) float32
        1 there, else 0.
    near : (h, w) float32
        The weight, smoothed as the contrast is, and not less than a little.
    """

    mask: UInt8Array
    seen: Float32Array
    share: Float32Array
    inside: UInt8Array
    weight: Float32Array
    near: Float32Array


def make_stencils(mask: UInt8Array) -> tuple[LevelMask, ...]:
    """Return the stencils of all levels of views that see floor where (h, w) `mask` is 255."""
    return stencils_from_half(_halved(mask))


def make_levels(
    view: View, stencils: Sequence[LevelMask] | None = None
) -> tuple[PyramidLevel, ...]:
    """Return a gray view's pyramid, from half resolution on, with what tells most at each level.

    The last level is small enough to be searched whole.

    Parameters
    ----------
    view : View
    stencils : sequence of LevelMask or None
        From `make_stencils` of the view's mask, where they are at hand.
    """
    if stencils is None:
        stencils = make_stencils(view.mask)
    return _levels(_halved(view.image), stencils, view.grid, view.frame_noise_gray)


def levels_from_half(
    image: UInt8Array, stencils: Sequence[LevelMask], grid: Grid
) -> tuple[PyramidLevel, ...]:
    """Return the pyramid of a view of which only its first level, at half resolution, is kept.

    Parameters
    ----------
    image : (h, w) uint8
    stencils : sequence of LevelMask
        From `stencils_from_half`.
    grid : Grid
        Of the whole view.
    """
    return _levels(image, stencils, grid, 0.0)


def _levels(
    image: UInt8Array, stencils: Sequence[LevelMask], grid: Grid, frame_noise_gray: float
) -> tuple[PyramidLevel, ...]:
    levels: list[PyramidLevel] = []
    pixel_from_metres, metres_per_pixel = grid.pixel_from_metres, grid.metres_per_pixel
    for stencil in stencils:
        pixel_from_metres, metres_per_pixel = _HALVE @ pixel_from_metres, 2.0 * metres_per_pixel
        noise_gray = None
        if levels:
            image, noise_gray = _halved(image), _HALVED_NOISE * levels[-1].noise_gray
        levels.append(
            _level(
                image, stencil, pixel_from_metres, metres_per_pixel, frame_noise_gray, noise_gray
            )
        )
    return tuple(levels)


def stencils_from_half(mask: UInt8Array) -> tuple[LevelMask, ...]:
    """Return the stencils of all levels, by the mask (h, w) of the first."""
    stencils = [_stencil(mask)]
    while len(stencils) < _MAX_LEVELS and (
        len(stencils) < _MIN_LEVELS or np.count_nonzero(mask == 255) > _MAX_COARSEST_PIXELS
    ):
        mask = _halved(mask)
        stencils.append(_stencil(mask))
    return tuple(stencils)


def _stencil(mask: UInt8Array) -> LevelMask:
    seen = (mask == 255).astype(np.float32)
    share = np.asarray(cv2.blur(seen, _HIGH_PASS_SIZE))
    # The outermost ring's gradient would be that of the mask, not of the floor.
    eroded = np.asarray(cv2.erode((mask == 255).astype(np.uint8), np.ones((5, 5))))
    # Where the border cuts much off the mean's window, another view's mean is another.
    whole = (eroded > 0) & (share >= _MIN_WINDOW_SHARE)
    weight = whole.astype(np.float32)
    near = np.asarray(cv2.GaussianBlur(weight, (0, 0), _CONTRAST_PIXELS))
    least = np.float32(1e-3)
    return LevelMask(
        mask,
        seen,
        np.maximum(share, least),
        np.where(whole, np.uint8(255), np.uint8(0)),
        weight,
        np.maximum(near, least),
    )


def _halved(picture: UInt8Array) -> UInt8Array:
    return np.asarray(cv2.pyrDown(picture), np.uint8)


def _level(
    image: UInt8Array,
    stencil: LevelMask,
    pixel_from_metres: Float64Array,
    metres_per_pixel: float,
    frame_noise_gray: float,
    noise_gray: float | None,
) -> PyramidLevel:
    detail = _detail(image, stencil)
    if noise_gray is None:
        noise_gray = _noise(detail, stencil.inside)
    right, up = slopes(detail, metres_per_pixel)
    chosen = _most_telling((right * right + up * up) * stencil.weight)
    rows, columns = np.unravel_index(chosen, detail.shape)
    points = apply_homography(invert(pixel_from_metres), np.column_stack([columns, rows]))
    gradients = np.column_stack([right.ravel()[chosen], up.ravel()[chosen]]).astype(np.float64)
    values = detail.ravel()[chosen].astype(np.float64)
    normalised = _normalised(detail, stencil, noise_gray)
    whole = max(float(cv2.countNonZero(stencil.inside)), 1.0)
    return PyramidLevel(
        pixel_from_metres,
        metres_per_pixel,
        image,
        stencil.mask,
        detail,
        stencil.inside,
        stencil.weight,
        points,
        values,
        gradients,
        noise_gray,
        normalised,
        float(cv2.norm(normalised, cv2.NORM_L2SQR)) / whole,
        frame_noise_gray,
    )


def _normalised(detail: Float32Array, stencil: LevelMask, noise_gray: float) -> Float32Array:
    """Return the detail with its local contrast evened out; 0 outside."""
    values = detail * stencil.weight
    variance = cv2.GaussianBlur(values * values, (0, 0), _CONTRAST_PIXELS) / stencil.near
    floor = np.float32((_MIN_CONTRAST_GRAY + _NOISE_TIMES * noise_gray) ** 2)
    return np.asarray(values / np.sqrt(variance + floor), np.float32)


def _noise(detail: Float32Array, inside: UInt8Array) -> float:
    """Return about one standard deviation of the camera's noise in a level's detail.

    The median of what neither planes nor edges leave (Immerkaer, Computer Vision and Image
    Understanding 64, 1996). Fine texture of the floor passes for noise, and is as strong.
    """
    left = np.abs(np.asarray(cv2.filter2D(detail, cv2.CV_32F, _NOISE_KERNEL)))[inside == 255]
    return _NOISE_FACTOR * float(np.median(left)) if left.size else 0.0


def _detail(image: UInt8Array, stencil: LevelMask) -> Float32Array:
    """Take out a picture's slow brightness, which belongs to lamp and lens.

    Both multiply: the logarithm makes that a sum, of which the high-pass leaves nothing. Without
    it a plain line would show the lens's vignetting, which does not move when the robot does.
    """
    values = np.asarray(cv2.LUT(image, _LOGARITHM)) * stencil.seen
    mean = np.asarray(cv2.blur(values, _HIGH_PASS_SIZE)) / stencil.share
    return np.asarray(cv2.GaussianBlur((values - mean) * stencil.seen, (3, 3), 0), np.float32)


def noise_gain(image: UInt8Array) -> Float32Array:
    """Return by how much a level's detail raises each pixel's noise: more where it is dark."""
    middle = np.float32(128.0 + _DARK_GRAY)
    return np.asarray(middle / (image.astype(np.float32) + np.float32(_DARK_GRAY)))


def slopes(detail: Float32Array, metres_per_pixel: float) -> tuple[Float32Array, Float32Array]:
    """Return the slopes per metre along x (right) and y (up)."""
    # Scharr's kernel sums to 32 over a span of two pixels' worth of slope.
    scale = 1.0 / (32.0 * metres_per_pixel)
    right = cv2.Scharr(detail, cv2.CV_32F, 1, 0, scale=scale)
    up = cv2.Scharr(detail, cv2.CV_32F, 0, 1, scale=-scale)
    return np.asarray(right, np.float32), np.asarray(up, np.float32)


def _most_telling(strength: Float32Array) -> Int64Array:
    """Return flat indices of the strongest gradients, by a sample of their distribution."""
    flat = strength.ravel()
    weaker = 1.0 - _MAX_TEMPLATE_PIXELS / flat.size
    least = float(np.quantile(flat[::_SAMPLE_STEP], weaker)) if weaker > 0 else 0.0
    return np.flatnonzero(flat > least)


def sample(image: Float32Array | UInt8Array, pixels: Float64Array) -> Float64Array:
    """Interpolate (h, w) at (N, 2) pixels; 0 outside. Folded, as remap limits its maps' sides."""
    count = len(pixels)
    rows = -(-count // _REMAP_COLUMNS)
    folded = np.full((2, rows * _REMAP_COLUMNS), -1e4, dtype=np.float32)
    folded[:, :count] = pixels.T
    columns_map, rows_map = folded.reshape(2, rows, _REMAP_COLUMNS)
    sampled = cv2.remap(image, columns_map, rows_map, cv2.INTER_LINEAR)
    return np.asarray(sampled, dtype=np.float64).ravel()[:count]
