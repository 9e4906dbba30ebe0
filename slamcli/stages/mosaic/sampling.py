"""Sampling of one camera image over a raster of the map, in a single interpolation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Grid, Pose2
from slamcli.stages.mosaic.compensation import correct
from slamcli.stages.mosaic.raster_projection import RasterProjection, project_raster
from slamcli.stages.mosaic.source_image import VIGNETTING_LEVEL, SourceImage

Value = TypeVar("Value", np.uint8, np.float32)
Window = tuple[slice, slice]


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """What one view shows of a raster.

    Attributes
    ----------
    image : (h, w, 3) uint8
    weight : (h, w) float32
        Resolution, pixels of the image per metre of floor, fading to 0 towards the border of the
        usable region; 0 where the floor is not seen.
    pixels_per_metre : (h, w) float32
        The resolution without the fading; valid only where the weight is not 0.
    """

    image: UInt8Array
    weight: Float32Array
    pixels_per_metre: Float32Array


def sample_image(
    source: SourceImage,
    calibration: Calibration,
    map_from_robot: Pose2,
    grid: Grid,
    *,
    smooth: bool = True,
) -> Sample:
    """Return what one frame's image shows of a raster in the map.

    Where the raster is coarser than the image, it is read from a smaller level of the image's
    pyramid, so that floor texture does not alias; the level is never so small that it blurs.

    Parameters
    ----------
    calibration : Calibration
        The frame's own: its tilt and height may differ from the others'.
    smooth : bool
        Interpolate by a bicubic kernel, which keeps more of the texture; else bilinear.
    """
    view = project_raster(source, calibration, map_from_robot, grid)
    image = np.zeros((grid.height, grid.width, 3), np.uint8)
    seen = (view.weight > 0).astype(np.uint8)
    coarsest, finest, _, _ = cv2.minMaxLoc(view.pixels_per_metre, seen)
    if finest <= 0:
        return Sample(image, view.weight, view.pixels_per_metre)
    scale = grid.metres_per_pixel * (1 + 1e-6)
    deepest = source.halvings + len(source.levels) - 1
    first, last = (
        min(deepest, max(source.halvings, math.floor(math.log2(value * scale))))
        for value in (coarsest, finest)
    )
    for number in range(first, last + 1):
        low = 2.0**number / scale if number > first else 0.0
        high = 2.0 ** (number + 1) / scale if number < last else math.inf
        band = cv2.inRange(view.pixels_per_metre, low, high)
        band = cv2.bitwise_and(band, band, mask=seen)
        left, top, width, height = cv2.boundingRect(band)
        if width == 0:
            continue
        window = slice(top, top + height), slice(left, left + width)
        read = _read(source.level(number), number, number, view, window, smooth=smooth)
        cv2.copyTo(_compensated(read, source, view, window), band[window], image[window])
    return Sample(image, view.weight, view.pixels_per_metre)


def _compensated(
    read: UInt8Array, source: SourceImage, view: RasterProjection, window: Window
) -> UInt8Array:
    """Return a window of a raster with the frame's gain and the lens's vignetting compensated."""
    factor = None
    if source.brightening is not None:
        factor = _read(source.brightening, VIGNETTING_LEVEL, 0, view, window, smooth=False)
    return correct(read, source.gain, factor)


def _read(
    level: NDArray[Value],
    number: int,
    halvings: int,
    view: RasterProjection,
    window: Window,
    *,
    smooth: bool,
) -> NDArray[Value]:
    """Read a window of a raster from a level that has a pixel for each 2^number of the image.

    Its pixel k lies at ``2^number k + (2^halvings - 1) / 2`` in the image: amid the pixels that it
    is the mean of after `halvings` halvings, or on one of them.
    """
    method = cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR
    scale = 0.5**number
    shifted = -scale * (2**halvings - 1) / 2
    if view.lens is not None:
        across, down = (np.float32(scale) * one[window] + np.float32(shifted) for one in view.lens)
        read = cv2.remap(level, across, down, method, borderMode=cv2.BORDER_REPLICATE)
    else:
        rows, columns = window
        level_from_image = np.array([[scale, 0.0, shifted], [0.0, scale, shifted], [0.0, 0.0, 1.0]])
        shift = np.array([[1.0, 0.0, columns.start], [0.0, 1.0, rows.start], [0.0, 0.0, 1.0]])
        read = cv2.warpPerspective(
            level,
            level_from_image @ view.image_from_pixel @ shift,
            (columns.stop - columns.start, rows.stop - rows.start),
            flags=method | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return np.asarray(read, level.dtype)
