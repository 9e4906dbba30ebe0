"""From one camera picture to a piece of the map in one resample, with how well it was seen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.lens import distort_points, undistorted_bounds
from slamcli.core.camera.resolution import floor_sampling
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.stages.mosaic import exposure

Value = TypeVar("Value", np.uint8, np.float32)

# Towards the border of what a picture shows its weight falls to nothing over this many pixels.
BORDER_PIXELS = 24
_MAX_LEVEL = 6
# A lens bends so smoothly that its effect is exact to a hundredth of a pixel between such points.
_LATTICE_PIXELS = 8
_LARGE_PIXELS = 128
_OUT_OF_SIGHT = -1.0e4
_MIN_DEPTH = 1.0e-6
# A camera that rocks sees the rim of the floor by so much less finely than it is calibrated to.
_ROCKING_SLACK = 1.1
# Vignetting changes so slowly that a value for each of so many pixels, each way, is enough.
_BRIGHTENING_LEVEL = 4


@dataclass(frozen=True, slots=True, eq=False)
class SourceImage:
    """A frame ready to be painted.

    Attributes
    ----------
    levels : tuple of (h, w, 3) uint8
        The image pyramid; each pixel of a level is the mean of two by two of the one before.
    halvings : int
        How often the first of them was halved already.
    usable : (H, W) uint8
        From `border_fade`, 0 where the frame's own mask hides the floor.
    gain : float
        What makes it as bright as the others.
    brightening : (h, w) float32 or None
        From `brightening`.
    """

    levels: tuple[UInt8Array, ...]
    halvings: int
    usable: UInt8Array
    gain: float
    brightening: Float32Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """What one view shows of a raster.

    Attributes
    ----------
    image : (h, w, 3) uint8
    weight : (h, w) float32
        Pixels of the picture to a metre of floor, fading to nothing towards the border of what is
        usable; 0 where the floor is not seen.
    pixels_per_metre : (h, w) float32
        The same without the fading; of use only where the weight is not 0.
    """

    image: UInt8Array
    weight: Float32Array
    pixels_per_metre: Float32Array


def border_fade(pixels_per_metre: Float32Array) -> UInt8Array:
    """Return (H, W): 255 well inside the usable part of a picture, 0 outside, fading between.

    Parameters
    ----------
    pixels_per_metre : (H, W) float32
        From `resolution_image`: 0 where no floor is seen.
    """
    usable = np.pad(np.where(pixels_per_metre > 0, np.uint8(255), np.uint8(0)), 1)
    distance = np.asarray(cv2.distanceTransform(usable, cv2.DIST_L2, 3))[1:-1, 1:-1]
    fade = np.minimum(distance * np.float32(255.0 / BORDER_PIXELS), np.float32(255.0))
    return np.asarray(np.ceil(fade), np.uint8)


def brightening(
    image_size: tuple[int, int], vignetting: tuple[float, float]
) -> Float32Array | None:
    """Return what undoes a lens's vignetting, as a `SourceImage` has it; None for an even lens."""
    return exposure.brightening_image(image_size, vignetting, 2**_BRIGHTENING_LEVEL)


def make_picture(
    image: UInt8Array,
    usable: UInt8Array,
    mask: UInt8Array | None,
    depth: int,
    gain: float = 1.0,
    brightening: Float32Array | None = None,
    *,
    halvings: int = 0,
) -> SourceImage:
    """Return a frame's pyramid down to its `depth`-th halving, and which of its pixels may be used.

    A small picture's ends sooner, with a side of one pixel.

    Parameters
    ----------
    image : (H, W, 3) or (H, W) uint8
        Halved so often as `halvings` tells.
    usable : (H, W) uint8
        From `border_fade`.
    mask : (H, W) uint8 or None
        The frame's own; 255 where the picture is opaque.
    gain : float
    brightening : (h, w) float32 or None
        As in `SourceImage`. What is read is corrected, not the picture: that is much less.
    """
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    levels = [image]
    while len(levels) <= depth - halvings and min(levels[-1].shape[:2]) > 1:
        levels.append(_halved(levels[-1]))
    if mask is not None:
        # What lies between an opaque pixel and another is a mixture.
        opaque = cv2.erode(mask, np.ones((3, 3), np.uint8))
        usable = np.where(opaque == 255, usable, np.uint8(0))
    return SourceImage(tuple(levels), halvings, usable, gain, brightening)


def _halved(image: UInt8Array) -> UInt8Array:
    """Return the means of two by two pixels; an odd last row or column is left out.

    A kernel with less aliasing, as `cv2.pyrDown` has, leaves less of the floor's texture.
    """
    height, width = image.shape[0] // 2, image.shape[1] // 2
    whole = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def pyramid_depth(calibration: Calibration, metres_per_pixel: float) -> int:
    """Return how many times a picture is halved before it is coarser than such a raster."""
    _, sharpest = _pixels_a_metre(calibration)
    return min(_MAX_LEVEL, int(math.log2(max(1.0, sharpest * metres_per_pixel))))


def may_be_halved(calibration: Calibration, metres_per_pixel: float) -> bool:
    """Tell whether such a raster is nowhere read from a level finer than half the picture's size.

    Not of pictures with an odd side: which of their pixels stay alone depends on how they are
    turned.
    """
    coarsest, _ = _pixels_a_metre(calibration)
    even = all(side % 2 == 0 for side in calibration.image_size)
    return even and coarsest * metres_per_pixel >= 2.0 * _ROCKING_SLACK


def _pixels_a_metre(calibration: Calibration) -> tuple[float, float]:
    """Return how many of its pixels a picture spends on a metre of floor, at least and at most."""
    floor = seen_floor(calibration)
    spacing = np.sqrt(floor_sampling(calibration, floor).prod(axis=1))
    return 1.0 / float(spacing.max()), 1.0 / float(spacing.min())


def sample(
    picture: SourceImage,
    calibration: Calibration,
    map_from_robot: Pose2,
    grid: Grid,
    *,
    smooth: bool = True,
) -> Sample:
    """Read a raster in the map from one frame's picture.

    Where the raster is coarser than the picture, it is read from a smaller level of the picture's
    pyramid, so that floor texture does not alias; a level is chosen never to blur.

    Parameters
    ----------
    calibration : Calibration
        The frame's own: its tilt and height may differ from the others'.
    smooth : bool
        Interpolate by a bicubic kernel, which keeps more of the texture; else bilinear.
    """
    look = _look(picture, calibration, map_from_robot, grid)
    image = np.zeros((grid.height, grid.width, 3), np.uint8)
    seen = (look.weight > 0).astype(np.uint8)
    coarsest, finest, _, _ = cv2.minMaxLoc(look.pixels_per_metre, seen)
    if finest <= 0:
        return Sample(image, look.weight, look.pixels_per_metre)
    scale = grid.metres_per_pixel * (1 + 1e-6)
    deepest = picture.halvings + len(picture.levels) - 1
    first, last = (
        min(deepest, max(picture.halvings, math.floor(math.log2(value * scale))))
        for value in (coarsest, finest)
    )
    for number in range(first, last + 1):
        low = 2.0**number / scale if number > first else 0.0
        high = 2.0 ** (number + 1) / scale if number < last else math.inf
        band = np.asarray(cv2.inRange(look.pixels_per_metre, low, high), np.uint8)
        band = np.asarray(cv2.bitwise_and(band, band, mask=seen), np.uint8)
        left, top, width, height = cv2.boundingRect(band)
        if width == 0:
            continue
        rows, columns = slice(top, top + height), slice(left, left + width)
        level = picture.levels[number - picture.halvings]
        read = _read(level, number, number, look, rows, columns, smooth=smooth)
        read = _lit(read, picture, look, rows, columns)
        cv2.copyTo(read, band[rows, columns], image[rows, columns])
    return Sample(image, look.weight, look.pixels_per_metre)


def weigh(
    picture: SourceImage, calibration: Calibration, map_from_robot: Pose2, grid: Grid
) -> Float32Array:
    """Return the weight alone of what `sample` would read."""
    return _look(picture, calibration, map_from_robot, grid).weight


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """One camera over one raster.

    Attributes
    ----------
    image_from_pixel : (3, 3) float64
        From the raster to the undistorted picture.
    lens : ((h, w) float32, (h, w) float32) or None
        Columns and rows in the distorted picture; None without distortion.
    pixels_per_metre, weight : (h, w) float32
        Pixels a metre, and that with all that is not usable at 0.
    """

    image_from_pixel: Float64Array
    lens: tuple[Float32Array, Float32Array] | None
    pixels_per_metre: Float32Array
    weight: Float32Array


def _look(
    picture: SourceImage, calibration: Calibration, map_from_robot: Pose2, grid: Grid
) -> _Look:
    robot_from_pixel = map_from_robot.inverse().matrix @ grid.metres_from_pixel
    homography = calibration.image_from_robot @ robot_from_pixel
    lens = None
    if np.any(calibration.distortion):
        lens = _lens_map(calibration, homography, grid)
        usable = cv2.remap(picture.usable, *lens, cv2.INTER_LINEAR)
    else:
        usable = cv2.warpPerspective(
            picture.usable,
            homography,
            (grid.width, grid.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
    pixels_per_metre = _resolution(calibration, robot_from_pixel, grid)
    scaled = cv2.multiply(usable, pixels_per_metre, scale=1.0 / 255.0, dtype=cv2.CV_32F)
    weight = np.asarray(scaled, np.float32)
    corners = map_from_robot.inverse().apply(grid.corners)
    if np.hypot(*corners.T).max() > calibration.max_range_metres:
        weight[_out_of_range(calibration, robot_from_pixel, grid)] = 0.0
    return _Look(homography, lens, pixels_per_metre, weight)


def _out_of_range(
    calibration: Calibration, robot_from_pixel: Float64Array, grid: Grid
) -> BoolArray:
    """Return (h, w): whether a pixel lies beyond the range.

    The squared distance of R p + t is |p|^2 s^2 + 2 t . R p + |t|^2: a sum of row and column.
    """
    offset = robot_from_pixel[:2, 2]
    column, row = np.arange(grid.width), np.arange(grid.height)
    scale = grid.metres_per_pixel**2
    along = scale * column**2 + 2 * float(offset @ robot_from_pixel[:2, 0]) * column
    down = scale * row**2 + 2 * float(offset @ robot_from_pixel[:2, 1]) * row
    limit = calibration.max_range_metres**2 - float(offset @ offset)
    return np.greater(along.astype(np.float32)[None, :], (limit - down).astype(np.float32)[:, None])


def _resolution(
    calibration: Calibration, robot_from_pixel: Float64Array, grid: Grid
) -> Float32Array:
    """Return (h, w) pixels a metre; of no use behind the camera, which no picture shows.

    A plane homography H enlarges areas by det H / w^3, and w is linear over the floor.
    """
    from_robot = calibration.image_from_robot
    row = from_robot[2] @ robot_from_pixel / abs(float(np.linalg.det(from_robot))) ** (1.0 / 3.0)
    column = (row[0] * np.arange(grid.width)).astype(np.float32)
    line = (row[1] * np.arange(grid.height) + row[2]).astype(np.float32)
    depth = column[None, :] + line[:, None]
    np.maximum(depth, np.float32(_MIN_DEPTH), out=depth)
    return np.asarray(cv2.pow(depth, -1.5), np.float32)


def _lit(
    read: UInt8Array, picture: SourceImage, look: _Look, rows: slice, columns: slice
) -> UInt8Array:
    """Return part of a raster, as it was read, as bright as the other frames and evenly so."""
    factor = None
    if picture.brightening is not None:
        here = _read(picture.brightening, _BRIGHTENING_LEVEL, 0, look, rows, columns, smooth=False)
        factor = np.asarray(here, np.float32)
    return exposure.correct(read, picture.gain, factor)


def _read(
    level: NDArray[Value],
    number: int,
    halvings: int,
    look: _Look,
    rows: slice,
    columns: slice,
    *,
    smooth: bool,
) -> NDArray[Value]:
    """Read part of a raster from a level that has a pixel for each 2^number of the picture.

    Its pixel k lies at ``2^number k + (2^halvings - 1) / 2`` in the picture: amid the pixels that
    it is the mean of, two by two so many times, or on one of them.
    """
    method = cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR
    scale = 0.5**number
    shifted = -scale * (2**halvings - 1) / 2
    if look.lens is not None:
        across, down = (
            np.float32(scale) * one[rows, columns] + np.float32(shifted) for one in look.lens
        )
        read = cv2.remap(level, across, down, method, borderMode=cv2.BORDER_REPLICATE)
    else:
        level_from_image = np.array([[scale, 0.0, shifted], [0.0, scale, shifted], [0.0, 0.0, 1.0]])
        shift = np.array([[1.0, 0.0, columns.start], [0.0, 1.0, rows.start], [0.0, 0.0, 1.0]])
        read = cv2.warpPerspective(
            level,
            level_from_image @ look.image_from_pixel @ shift,
            (columns.stop - columns.start, rows.stop - rows.start),
            flags=method | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return np.asarray(read, level.dtype)


def _lens_map(
    calibration: Calibration, homography: Float64Array, grid: Grid
) -> tuple[Float32Array, Float32Array]:
    """Return where each pixel of a raster lies in the camera's own, distorted picture.

    Exact on a lattice, interpolated between its points.
    """
    # A power of two: OpenCV interpolates in steps of 1/32.
    step = _LATTICE_PIXELS if min(grid.width, grid.height) >= _LARGE_PIXELS else 2
    across, down = -(-grid.width // step) + 1, -(-grid.height // step) + 1
    columns, rows = np.meshgrid(
        step * np.arange(across, dtype=np.float64), step * np.arange(down, dtype=np.float64)
    )
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    undistorted = apply_homography(homography, pixels)
    depth = pixels @ homography[2, :2] + homography[2, 2]
    low, high = undistorted_bounds(calibration)
    # Far outside the picture the lens polynomial folds back into it; near its border it does not.
    slack = 0.05 * (high - low)
    outside = (depth <= 0) | ~np.all(
        (undistorted >= low - slack) & (undistorted <= high + slack), axis=1
    )
    undistorted[outside] = low
    places = distort_points(calibration, undistorted)
    places[outside] = _OUT_OF_SIGHT
    lattice = places.reshape(down, across, 2).astype(np.float32)
    matrix = np.array([[1.0 / step, 0.0, 0.0], [0.0, 1.0 / step, 0.0]])
    both = np.asarray(
        cv2.warpAffine(
            lattice,
            matrix,
            (grid.width, grid.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.float32,
    )
    return np.ascontiguousarray(both[..., 0]), np.ascontiguousarray(both[..., 1])
