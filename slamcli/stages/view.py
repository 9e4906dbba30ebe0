"""Inverse perspective mapping: the camera's picture to a bird's-eye view, in one resample."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import ConvexHull

from slamcli.core.arrays import BoolArray, Float32Array, Int16Array, Int64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import (
    compared_metres_per_pixel,
    default_metres_per_pixel,
    footprint,
    footprint_hull,
)
from slamcli.core.camera.projection import SamplingMap, sampling_map
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.errors import FrameError, other_size
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Frame, View
from slamcli.core.robust import NORMAL_MEDIAN

# A view of about half a megapixel has enough points, and warps and detects in milliseconds
# [guarded by benchmarks/accuracy.py and benchmarks/streaming.py].
_REGISTRATION_PIXELS = 0.5e6
_MAX_LEVEL = 4
_FOLDED_COLUMNS = 256
# Up to this many times the range of features a line or an edge is still of use; a view that gains
# less floor than this by it is not worth its time [guarded by benchmarks/robustness.py].
_FAR_TIMES = 2.2
_FAR_COARSER = 2.0
_MIN_FAR_GAIN = 1.3
# A picture with less contrast than its own noise shows nothing that could be matched
# [guarded by tests/stages/test_view.py].
_MIN_DEVIATION_GRAY = 1.0
_SATURATED_GRAY = 250
_MAX_SATURATED_SHARE = 0.98
# Noise is measured in some blocks of a frame, in those of them that are smoothest.
_NOISE_BLOCK_PIXELS = 20
_NOISE_BLOCKS = 200
_SMOOTHEST_SHARE = 0.1
_DARK_GRAY = 8


@dataclass(frozen=True, slots=True, eq=False)
class Resampler:
    """The precomputed mapping from a camera's pictures to one raster on the floor.

    Attributes
    ----------
    grid : Grid
    mask : (h, w) uint8
        255 where the calibrated camera sees floor, else 0.
    bands : tuple of Band
        One for each level of the image pyramid that the raster needs.
    """

    grid: Grid
    mask: UInt8Array
    bands: tuple[Band, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """The pixels of a raster that are read from one level of the picture's pyramid.

    Attributes
    ----------
    level : int
        0 is the picture itself.
    pixels : (N,) int64
        Numbers of the raster's pixels, row by row.
    columns_read, rows_read : (r, c) float32
        Pixels of the level, folded, as OpenCV limits the sides of its maps: one for each of the
        raster's, or as many in a row as it is the mean of; filled up with the first ones.
    """

    level: int
    pixels: Int64Array
    columns_read: Float32Array
    rows_read: Float32Array


def registration_metres_per_pixel(calibration: Calibration) -> float:
    """Return the resolution of the views that features are detected in.

    The default, or coarser where that makes vast views.
    """
    finest = default_metres_per_pixel(calibration)
    grid = footprint(calibration, finest)
    shrink = math.sqrt(grid.width * grid.height / _REGISTRATION_PIXELS)
    return finest * max(1.0, shrink)


def make_resampler(
    calibration: Calibration,
    pixels_per_metre: Float32Array,
    grid: Grid,
    robot_from_grid: Pose2,
    *,
    antialias: bool = False,
) -> Resampler:
    """Prepare to paint a raster on the floor from pictures of one camera.

    Where the raster is coarser than the picture, it is read from a smaller level of the picture's
    pyramid, so that floor texture does not alias; a level is chosen never to blur.

    Parameters
    ----------
    pixels_per_metre : (H, W) float32
        From `resolution_image`, or weights of the same zeros.
    antialias : bool
        Whether, where the level is still finer than the raster, each pixel is the mean of four.
    """
    mapping = sampling_map(calibration, pixels_per_metre, grid, robot_from_grid)
    finer = mapping
    if antialias:
        scale, width, height = grid.metres_per_pixel / 2.0, 2 * grid.width, 2 * grid.height
        twice = Grid(grid.x_min, grid.y_max, scale, width, height)
        finer = sampling_map(calibration, pixels_per_metre, twice, robot_from_grid)
    seen = mapping.pixels_per_metre > 0
    # How many of the picture's pixels to one of the raster's, side by side.
    coarser = mapping.pixels_per_metre * np.float32(grid.metres_per_pixel)
    deepest = min(_MAX_LEVEL, int(math.log2(max(float(coarser.max(initial=0.0)), 1.0))))
    bands = []
    for number in range(deepest + 1):
        inside = seen
        if number > 0:
            inside = inside & (coarser >= 2.0**number)
        if number < deepest:
            inside = inside & (coarser < 2.0 ** (number + 1))
        fine = antialias & (coarser >= 1.0)
        for part, places in ((inside & ~fine, mapping), (inside & fine, finer)):
            if part.any():
                bands.append(_band(places, part, calibration.image_size, number))
    return Resampler(grid, np.where(seen, np.uint8(255), np.uint8(0)), tuple(bands))


def _band(mapping: SamplingMap, inside: BoolArray, image_size: tuple[int, int], level: int) -> Band:
    """Return the band of some of a raster's pixels, read once or, by a finer mapping, four times.

    All within the level's picture, its border repeated: OpenCV is slow where a map leads outside.
    """
    pixels = np.flatnonzero(inside)
    height, width = inside.shape
    times = mapping.columns.shape[0] // height
    folded = np.resize(pixels, (-(-len(pixels) // _FOLDED_COLUMNS), _FOLDED_COLUMNS))
    # pyrDown keeps every other pixel, so pixel k of a level is pixel 2^level k of the picture.
    scale, steps = np.float32(0.5**level), 2**level
    maps = []
    for places, side in zip((mapping.columns, mapping.rows), image_size, strict=True):
        each = places.reshape(height, times, width, times).transpose(0, 2, 1, 3)
        read = each.reshape(-1, times**2)[folded].reshape(len(folded), -1)
        maps.append(np.clip(read * scale, 0, -(-side // steps) - 1).astype(np.float32))
    return Band(level, pixels, maps[0], maps[1])


def make_view_resampler(
    calibration: Calibration, metres_per_pixel: float, *, antialias: bool = False
) -> Resampler:
    """Prepare the camera's own bird's-eye view, in the robot frame; see `make_resampler`."""
    grid, sharp = footprint(calibration, metres_per_pixel), resolution_image(calibration)
    return make_resampler(calibration, sharp, grid, Pose2(), antialias=antialias)


def make_compared_resamplers(
    calibration: Calibration, metres_per_pixel: float, *, far: bool
) -> list[Resampler]:
    """Prepare the views that are compared by their pixels.

    Parameters
    ----------
    calibration : Calibration
    metres_per_pixel : float
        Of the views that features are detected in.
    far : bool
        Whether a coarser view of the floor beyond is wanted too, where the camera sees much of it.
    """
    compared = compared_metres_per_pixel(calibration, metres_per_pixel)
    # An edge that aliases moves with the camera, not with the floor
    # [benchmarks/streaming.py, course: steps err by 1.4 times as much without].
    near = make_view_resampler(calibration, compared, antialias=True)
    beyond = make_far_resampler(calibration, compared) if far else None
    return [near] if beyond is None else [near, beyond]


def make_far_resampler(calibration: Calibration, metres_per_pixel: float) -> Resampler | None:
    """Prepare a coarser view that reaches beyond the range, where the floor is seen smeared.

    None where the camera sees little more floor there.
    """
    far = replace(calibration, max_range_metres=_FAR_TIMES * calibration.max_range_metres)
    near_area = ConvexHull(footprint_hull(calibration)).volume
    if ConvexHull(footprint_hull(far)).volume < _MIN_FAR_GAIN * near_area:
        return None
    return make_view_resampler(far, _FAR_COARSER * metres_per_pixel, antialias=True)


def resample(image: UInt8Array, resampler: Resampler) -> UInt8Array:
    """Paint the raster from a picture (H, W) or (H, W, 3); black where no floor is seen."""
    grid = resampler.grid
    painted = np.zeros((grid.height, grid.width, *image.shape[2:]), dtype=np.uint8)
    level_image, level = image, 0
    for band in resampler.bands:
        while level < band.level:
            level_image, level = np.asarray(cv2.pyrDown(level_image), dtype=np.uint8), level + 1
        read = cv2.remap(level_image, band.columns_read, band.rows_read, cv2.INTER_LINEAR)
        if read.shape[1] != _FOLDED_COLUMNS:
            size = _FOLDED_COLUMNS, len(read)
            read = cv2.resize(read, size, interpolation=cv2.INTER_AREA)
        values = np.asarray(read).reshape(-1, *image.shape[2:])[: len(band.pixels)]
        painted.reshape(-1, *image.shape[2:])[band.pixels] = values
    return painted


def make_view(frame: Frame, resampler: Resampler, *, gray: bool) -> View:
    """Return the frame's bird's-eye view; pixels that the frame masks out are not seen."""
    image = to_gray(frame.image) if gray else frame.image
    return View(resampler.grid, resample(image, resampler), _seen(frame, resampler))


def make_compared_views(frame: Frame, resamplers: Iterable[Resampler]) -> list[View]:
    """Return gray views of one frame with its noise, for comparison by their pixels."""
    image = to_gray(frame.image)
    noise = noise_gray(image)
    return [View(r.grid, resample(image, r), _seen(frame, r), noise) for r in resamplers]


def _seen(frame: Frame, resampler: Resampler) -> UInt8Array:
    if frame.mask is None:
        return resampler.mask
    return np.where(resample(frame.mask, resampler) == 255, resampler.mask, np.uint8(0))


def noise_gray(image: UInt8Array) -> float:
    """Return about one standard deviation of the noise in a gray camera picture (H, W).

    What neither planes nor edges leave (Immerkaer, Computer Vision and Image Understanding 64,
    1996), in the picture's smoothest blocks, where the floor has no texture of its own. What a
    camera or a codec smoothed away is not counted; nor are blocks that are black or burnt out.
    """
    blocks = _blocks(image)
    level = blocks.reshape(len(blocks), -1).mean(axis=1)
    blocks = blocks[(level > _DARK_GRAY) & (level < _SATURATED_GRAY)]
    if not len(blocks):
        return 0.0
    left = blocks[:, :, :-2] - 2 * blocks[:, :, 1:-1] + blocks[:, :, 2:]
    left = left[:, :-2] - 2 * left[:, 1:-1] + left[:, 2:]
    sizes = np.abs(left).reshape(len(left), -1)
    # Sorted by vector instructions, several times as fast as numpy finds two medians.
    middle = sizes.shape[1] // 2
    sizes = np.sort(sizes, axis=1)[:, middle - 1 : middle + 1].mean(axis=1)
    # The kernel's weights squared sum to 36.
    return float(np.quantile(sizes, _SMOOTHEST_SHARE)) / (6.0 * NORMAL_MEDIAN)


def _blocks(image: UInt8Array) -> Int16Array:
    """Return square blocks spread over a picture, (N, side, side), N at most some hundreds."""
    height, width = image.shape
    step = max(_NOISE_BLOCK_PIXELS, math.isqrt(height * width // _NOISE_BLOCKS))
    windows = np.lib.stride_tricks.sliding_window_view(image, (_NOISE_BLOCK_PIXELS,) * 2)
    spread = windows[::step, ::step].reshape(-1, _NOISE_BLOCK_PIXELS, _NOISE_BLOCK_PIXELS)
    return spread.astype(np.int16)


def to_gray(image: UInt8Array) -> UInt8Array:
    """Return (H, W) luminance of a gray or BGR picture."""
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def to_colour(image: UInt8Array) -> UInt8Array:
    """Return (H, W, 3) BGR of a gray or BGR picture."""
    if image.ndim == 3:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def check_frame(frame: Frame, calibration: Calibration) -> None:
    """Raise FrameError for a frame that the calibration's camera cannot have taken."""
    image = frame.image
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        raise FrameError("not an array of 8-bit pixels; convert it to uint8 BGR or gray")
    if image.ndim not in {2, 3} or (image.ndim == 3 and image.shape[2] != 3):
        raise FrameError(f"pixels of shape {image.shape}; gray (H, W) or BGR (H, W, 3) is needed")
    size = (image.shape[1], image.shape[0])
    if size != calibration.image_size:
        raise other_size(size, calibration.image_size)


def check_view(view: View) -> None:
    """Raise FrameError when the floor part of a gray view shows nothing that could be matched."""
    count = cv2.countNonZero(view.mask)
    if count == 0:
        raise FrameError("no floor in the frame: all of it is masked or out of range")
    # From sums of bytes, which are exact; floor that is not seen is black.
    mean = cv2.sumElems(cv2.bitwise_and(view.image, view.mask))[0] / count
    square = cv2.norm(view.image, cv2.NORM_L2SQR, mask=view.mask) / count
    deviation = math.sqrt(max(square - mean**2, 0.0))
    if deviation < _MIN_DEVIATION_GRAY:
        word = "black" if mean < 16 else "white" if mean > 239 else "blank"
        raise FrameError(f"the floor is all {word} (mean gray {mean:.0f}): nothing to match")
    bright = cv2.bitwise_and(cv2.inRange(view.image, _SATURATED_GRAY, 255), view.mask)
    saturated = cv2.countNonZero(bright) / count
    if saturated > _MAX_SATURATED_SHARE:
        raise FrameError(f"overexposed: {saturated:.0%} of the floor is white; lower the exposure")
