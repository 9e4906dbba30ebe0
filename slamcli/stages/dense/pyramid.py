"""The image pyramid of a view, each level ready for photometric comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import apply_homography, invert
from slamcli.core.light import SATURATION, light_of_codes
from slamcli.core.records import NormalisedDetail, PyramidLevel, Template, View
from slamcli.core.robust import NORMAL_MEDIAN

# Down to where a search over every rotation and translation costs some tens of milliseconds
# [benchmarks/stages.py; guarded by benchmarks/accuracy.py].
_MIN_LEVELS = 2
_MAX_LEVELS = 6
_MAX_COARSEST_PIXELS = 20_000
_MAX_TEMPLATE_PIXELS = 15_000
_HIGH_PASS_SIZE = (25, 25)
# Share of the high-pass's window that must be seen: elsewhere views differ in its mean
# [guarded by benchmarks/robustness.py: course].
_MIN_WINDOW_SHARE = 0.7
_SAMPLE_STEP = 16
# Of a level's rows, those in which noise is measured: tens of thousands of pixels are enough.
_NOISE_ROWS = 8
_CONTRAST_PIXELS = 5.0
# What is flatter than this is noise; its contrast is not to be raised to that of a line. Absolute,
# as the picture's own contrast may be that of a dark obstacle on a pale floor
# [guarded by benchmarks/robustness.py: noise and legs on bare].
_MIN_CONTRAST_GRAY = 1.0
_NOISE_TIMES = 3.0
# White noise, resampled to a view and smoothed as the detail is, leaves its deviation over 1.0 to
# 2.1, about 1.4; the median of its size is 0.6745 deviations. Halving leaves 0.47 of it.
_NOISE_FACTOR = 1.4 / NORMAL_MEDIAN
_HALVED_NOISE = 0.47
# pyrDown keeps even pixels, so a level's pixel is half the one before's.
_HALVE = np.diag([0.5, 0.5, 1.0])
# Views are compared by a power of light. In light itself a blurred edge of white paint on black
# stays in the middle of its step, wherever it is seen from, but the noise of white counts most; in
# the gray levels of a picture, about the power 0.45, noise counts alike, but edges move with their
# blur, and in the logarithm twice as far [the sample, ATE by the logarithm, 0.45, 0.7 and 1: 0.88,
# 0.68, 0.47, 0.35 mm; median error of a step 0.037, 0.040, 0.043, 0.067 mm].
_POWER_OF_LIGHT = 0.7
# Share of white that is added to what is around a pixel before its contrast is taken, which would
# otherwise amplify the noise of dark pixels [guarded by benchmarks/robustness.py: noise, flicker].
_DARK = np.float32(0.03)
_REMAP_COLUMNS = 256
_BRIGHTNESS_OF_CODES = (light_of_codes("srgb") / SATURATION) ** _POWER_OF_LIGHT
# Of each gray level, a share of white's, and how fast it grows with the gray level.
_BRIGHTNESS = _BRIGHTNESS_OF_CODES.astype(np.float32)
_BRIGHTNESS_PER_GRAY = np.gradient(_BRIGHTNESS_OF_CODES).astype(np.float32)
# Contrast is counted in gray levels at the middle of the range.
_GRAY_PER_CONTRAST = np.float32((_BRIGHTNESS[128] + _DARK) / _BRIGHTNESS_PER_GRAY[128])


@dataclass(frozen=True, slots=True, eq=False)
class LevelMask:
    """Where a pyramid level sees floor, with derived weights; the same for all frames of a camera.

    Attributes
    ----------
    mask : (h, w) uint8
        255 where all of a pixel was seen.
    seen : (h, w) float32
        1 there, else 0.
    share : (h, w) float32
        Of the high-pass's window around a pixel, what was seen; at least 0.001.
    inside : (h, w) uint8
        255 where the detail and its gradient are free of the mask's border.
    weight : (h, w) float32
        1 there, else 0.
    near : (h, w) float32
        The weight, smoothed as the contrast is; at least 0.001.
    """

    mask: UInt8Array
    seen: Float32Array
    share: Float32Array
    inside: UInt8Array
    weight: Float32Array
    near: Float32Array


def make_level_masks(mask: UInt8Array) -> tuple[LevelMask, ...]:
    """Return the masks of all levels of views that see floor where (h, w) `mask` is 255."""
    level_masks = [_level_mask(mask)]
    while len(level_masks) < _MAX_LEVELS and (
        len(level_masks) < _MIN_LEVELS or np.count_nonzero(mask == 255) > _MAX_COARSEST_PIXELS
    ):
        mask = _halved(mask)
        level_masks.append(_level_mask(mask))
    return tuple(level_masks)


def make_levels(
    view: View,
    level_masks: Sequence[LevelMask] | None = None,
    max_points: int | None = None,
) -> tuple[PyramidLevel, ...]:
    """Return a gray view's pyramid: the view itself, and smaller ones.

    The last level is small enough to be searched whole.

    Parameters
    ----------
    view : View
    level_masks : sequence of LevelMask or None
        From `make_level_masks` of the view's mask, where that was done before.
    max_points : int or None
        Of the finest level's template, evenly sampled of those that it has otherwise; a quarter of
        them on the next, as it has a quarter of the pixels.
    """
    image, pixel_from_metres = view.image, view.grid.pixel_from_metres
    metres_per_pixel = view.grid.metres_per_pixel
    levels: list[PyramidLevel] = []
    noise_gray: Deferred[float] | None = None
    for level_mask in level_masks or make_level_masks(view.mask):
        if levels:
            image, pixel_from_metres = _halved(image), _HALVE @ pixel_from_metres
            metres_per_pixel *= 2.0
        detail = _detail(image, level_mask)
        noise_gray = Deferred(
            partial(_noise, detail, level_mask.inside)
            if noise_gray is None
            else partial(_halved_noise, noise_gray)
        )
        levels.append(
            PyramidLevel(
                pixel_from_metres,
                metres_per_pixel,
                image,
                level_mask.mask,
                detail,
                level_mask.inside,
                level_mask.weight,
                Deferred(
                    partial(
                        _template,
                        detail,
                        level_mask.weight,
                        pixel_from_metres,
                        metres_per_pixel,
                        None if max_points is None else max_points >> 2 * len(levels),
                    )
                ),
                Deferred(partial(_contrast, detail, level_mask, noise_gray)),
                view.frame_noise_gray,
            )
        )
    return tuple(levels)


def halved(view: View) -> View:
    """Return a gray view as the second level of its pyramid shows it."""
    return replace(view, grid=view.grid.halved, image=_halved(view.image), mask=_halved(view.mask))


def _level_mask(mask: UInt8Array) -> LevelMask:
    seen = (mask == 255).astype(np.float32)
    share = np.asarray(cv2.blur(seen, _HIGH_PASS_SIZE))
    # The gradient of the outermost ring is that of the mask, not of the floor.
    eroded = np.asarray(cv2.erode((mask == 255).astype(np.uint8), np.ones((5, 5))))
    # Where the border cuts much off the window of the mean, the means of two views differ.
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


def _template(
    detail: Float32Array,
    weight: Float32Array,
    pixel_from_metres: Float64Array,
    metres_per_pixel: float,
    max_points: int | None,
) -> Template:
    """Return the points of a level with the strongest gradients."""
    right, up = slopes(detail, metres_per_pixel)
    chosen = _strongest_gradients((right * right + up * up) * weight)
    if max_points is not None:
        chosen = chosen[:: max(1, -(-len(chosen) // max_points))]
    rows, columns = np.unravel_index(chosen, detail.shape)
    points = apply_homography(invert(pixel_from_metres), np.column_stack([columns, rows]))
    gradients = np.column_stack([right.ravel()[chosen], up.ravel()[chosen]]).astype(np.float64)
    return Template.of(points, detail.ravel()[chosen].astype(np.float64), gradients)


def _contrast(
    detail: Float32Array, level_mask: LevelMask, noise_gray: Deferred[float]
) -> NormalisedDetail:
    normalised = _normalised(detail, level_mask, noise_gray.value)
    whole = max(float(cv2.countNonZero(level_mask.inside)), 1.0)
    return NormalisedDetail(normalised, float(cv2.norm(normalised, cv2.NORM_L2SQR)) / whole)


def _normalised(detail: Float32Array, level_mask: LevelMask, noise_gray: float) -> Float32Array:
    """Return the detail with its local contrast evened out; 0 outside."""
    values = detail * level_mask.weight
    variance = cv2.GaussianBlur(values * values, (0, 0), _CONTRAST_PIXELS) / level_mask.near
    floor = np.float32((_MIN_CONTRAST_GRAY + _NOISE_TIMES * noise_gray) ** 2)
    return np.asarray(values / np.sqrt(variance + floor), np.float32)


def _noise(detail: Float32Array, inside: UInt8Array) -> float:
    """Return about one standard deviation of the camera's noise in a level's detail.

    The median of what remains without planes and edges (Immerkaer, Computer Vision and Image
    Understanding 64, 1996). It counts fine texture of the floor as noise.
    """
    above, middle, below = (detail[row::_NOISE_ROWS] for row in range(3))
    count = len(below)
    remaining = above[:count] - 2.0 * middle[:count] + below
    remaining = remaining[:, :-2] - 2.0 * remaining[:, 1:-1] + remaining[:, 2:]
    # Sorted by vector instructions, several times as fast as numpy finds a median.
    seen = inside[1::_NOISE_ROWS, 1:-1][:count] == 255
    sizes = np.sort(np.abs(remaining[seen]))
    return _NOISE_FACTOR * float(sizes[len(sizes) // 2]) if sizes.size else 0.0


def _halved_noise(noise_gray: Deferred[float]) -> float:
    return _HALVED_NOISE * noise_gray.value


def _detail(image: UInt8Array, level_mask: LevelMask) -> Float32Array:
    """Return each pixel's contrast to what is around it (Weber contrast): floor without lamp.

    Lamp and lens are factors that vary slowly: in the quotient they cancel. Without it a plain line
    would show the lens's vignetting, which does not move when the robot does.
    """
    seen = level_mask.seen
    brightness = cv2.multiply(brightness_of(image), seen)
    around = cv2.divide(cv2.blur(brightness, _HIGH_PASS_SIZE), level_mask.share)
    around = at_least_dark(np.asarray(around, np.float32))
    contrast = cv2.divide(brightness, around, scale=float(_GRAY_PER_CONTRAST))
    contrast = cv2.scaleAdd(seen, -float(_GRAY_PER_CONTRAST), contrast)
    return np.asarray(cv2.GaussianBlur(contrast, (3, 3), 0), np.float32)


def brightness_of(image: UInt8Array) -> Float32Array:
    """Return the power of light of gray levels, a share of white's, and what is added to it."""
    return np.asarray(cv2.LUT(image, _BRIGHTNESS + _DARK), np.float32)


def at_least_dark(brightness: Float32Array) -> Float32Array:
    """Return mean brightness as contrast is taken to it."""
    return np.maximum(brightness, _DARK)


def contrast_of(brightness: Float32Array, around: Float32Array) -> Float32Array:
    """Return contrast, in gray levels, of brightness to what is around it."""
    return _GRAY_PER_CONTRAST * (brightness / around - np.float32(1.0))


def noise_gain(image: UInt8Array) -> Float32Array:
    """Return the factor by which a level's detail amplifies each pixel's noise: more where dark."""
    brightness = np.asarray(cv2.LUT(image, _BRIGHTNESS), np.float32)
    around = np.asarray(cv2.blur(brightness, _HIGH_PASS_SIZE), np.float32) + _DARK
    slope = np.asarray(cv2.LUT(image, _BRIGHTNESS_PER_GRAY), np.float32)
    return _GRAY_PER_CONTRAST * slope / around


def slopes(detail: Float32Array, metres_per_pixel: float) -> tuple[Float32Array, Float32Array]:
    """Return the slopes per metre along x (right) and y (up)."""
    # Scharr's kernel sums to 32 over a span of two pixels' worth of slope.
    scale = 1.0 / (32.0 * metres_per_pixel)
    right = cv2.Scharr(detail, cv2.CV_32F, 1, 0, scale=scale)
    up = cv2.Scharr(detail, cv2.CV_32F, 0, 1, scale=-scale)
    return np.asarray(right, np.float32), np.asarray(up, np.float32)


def _strongest_gradients(strength: Float32Array) -> Int64Array:
    """Return flat indices of the strongest gradients, by a sample of their distribution."""
    flat = strength.ravel()
    weaker = 1.0 - _MAX_TEMPLATE_PIXELS / flat.size
    least = float(np.quantile(flat[::_SAMPLE_STEP], weaker)) if weaker > 0 else 0.0
    return np.flatnonzero(flat > least)


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places in a level between its pixels, where its pictures are interpolated.

    Attributes
    ----------
    maps : (2, rows, columns) float32
        Columns and rows to read, folded, as OpenCV limits the sides of its maps.
    chosen : (N,) int64
        Those of interest, in the order of the maps.
    """

    maps: Float32Array
    chosen: Int64Array

    @classmethod
    def of(cls, pixels: Float64Array | Float32Array) -> Places:
        """Return (2, N) columns and rows as places, all of interest."""
        count = pixels.shape[1]
        rows = -(-count // _REMAP_COLUMNS)
        folded = np.full((2, rows * _REMAP_COLUMNS), -1e4, dtype=np.float32)
        folded[:, :count] = pixels
        return cls(folded.reshape(2, rows, _REMAP_COLUMNS), np.arange(count))

    def among(self, picture: UInt8Array) -> Places:
        """Return the places all around which a mask (h, w) is 255."""
        seen = cv2.remap(picture, self.maps[0], self.maps[1], cv2.INTER_LINEAR)
        return Places(self.maps, np.flatnonzero(np.asarray(seen).ravel() == 255))

    def part(self, some: slice) -> Places:
        """Return some of the places of interest, alone."""
        chosen = self.chosen[some]
        return Places.of(self.maps.reshape(2, -1)[:, chosen])

    def sample(self, image: Float32Array) -> Float64Array:
        """Return (N,) values of a picture (h, w) there; 0 outside."""
        sampled = cv2.remap(image, self.maps[0], self.maps[1], cv2.INTER_LINEAR)
        return np.asarray(sampled).ravel()[self.chosen].astype(np.float64)


def sample(image: Float32Array, pixels: Float64Array) -> Float64Array:
    """Interpolate (h, w) at (N, 2) pixels; 0 outside."""
    return Places.of(pixels.T).sample(image)
