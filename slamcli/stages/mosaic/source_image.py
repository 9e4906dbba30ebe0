"""A frame's image prepared for the mosaic: its pyramid, its usable region and its exposure."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.resolution import floor_sampling
from slamcli.stages.mosaic.compensation import brightening_image

# Over this many pixels towards the border of the usable region the weight falls to 0, so that a
# seam along the border is feathered [guarded by benchmarks/blends.py].
BORDER_PIXELS = 24
# Vignetting changes so slowly that one value for 2^4 by 2^4 pixels is enough.
VIGNETTING_LEVEL = 4
# Coarser levels than this would save no time [guarded by benchmarks/stages.py].
_MAX_LEVEL = 6
# A rocking camera sees the rim of the floor at a resolution lower than the calibrated one by up to
# this factor [guarded by benchmarks/blends.py].
_ROCKING_SLACK = 1.1


@dataclass(frozen=True, slots=True, eq=False)
class SourceImage:
    """A frame ready to be painted from.

    Attributes
    ----------
    levels : tuple of (h, w, 3) uint8
        The image pyramid; each pixel of a level is the mean of two by two of the one before.
    halvings : int
        How often the first level was halved already.
    usable : (H, W) uint8
        From `border_fade`, 0 where the frame's own mask hides the floor.
    gain : float
        Exposure compensation: the factor that makes it as bright as the others.
    brightening : (h, w) float32 or None
        From `brightening`.
    """

    levels: tuple[UInt8Array, ...]
    halvings: int
    usable: UInt8Array
    gain: float
    brightening: Float32Array | None

    def level(self, number: int) -> UInt8Array:
        """Return the image halved `number` times, `halvings` at least."""
        return self.levels[number - self.halvings]


def border_fade(pixels_per_metre: Float32Array) -> UInt8Array:
    """Return (H, W): 255 well inside the usable part of an image, 0 outside, fading between.

    Parameters
    ----------
    pixels_per_metre : (H, W) float32
        From `resolution_image`: 0 where no floor is seen.
    """
    usable = np.pad(np.where(pixels_per_metre > 0, np.uint8(255), np.uint8(0)), 1)
    distance = cv2.distanceTransform(usable, cv2.DIST_L2, 3)[1:-1, 1:-1]
    fade = np.minimum(distance * np.float32(255.0 / BORDER_PIXELS), np.float32(255.0))
    return np.asarray(np.ceil(fade), np.uint8)


def brightening(
    image_size: tuple[int, int], vignetting: tuple[float, float]
) -> Float32Array | None:
    """Return what undoes a lens's vignetting, as a `SourceImage` has it; None for an even lens."""
    return brightening_image(image_size, vignetting, 2**VIGNETTING_LEVEL)


def make_source_image(
    image: UInt8Array,
    usable: UInt8Array,
    mask: UInt8Array | None,
    depth: int,
    gain: float = 1.0,
    brightening: Float32Array | None = None,
    *,
    halvings: int = 0,
) -> SourceImage:
    """Return a frame's pyramid down to its `depth`-th halving, and which of its pixels are usable.

    The pyramid of a small image ends sooner, with a side of one pixel.

    Parameters
    ----------
    image : (H, W, 3) or (H, W) uint8
        Halved `halvings` times.
    usable : (H, W) uint8
        From `border_fade`.
    mask : (H, W) uint8 or None
        The frame's own; 255 where the image is opaque.
    gain : float
    brightening : (h, w) float32 or None
        As in `SourceImage`. The samples are corrected, not the image: those are far fewer pixels.
    """
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    levels = [image]
    while len(levels) <= depth - halvings and min(levels[-1].shape[:2]) > 1:
        levels.append(_half_size(levels[-1]))
    if mask is not None:
        # What lies between an opaque pixel and another is a mixture.
        opaque = cv2.erode(mask, np.ones((3, 3), np.uint8))
        usable = np.where(opaque == 255, usable, np.uint8(0))
    return SourceImage(tuple(levels), halvings, usable, gain, brightening)


def _half_size(image: UInt8Array) -> UInt8Array:
    """Return the means of two by two pixels; an odd last row or column is left out.

    A kernel with less aliasing, as `cv2.pyrDown` has, leaves less of the floor's texture.
    """
    height, width = image.shape[0] // 2, image.shape[1] // 2
    whole = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def pyramid_depth(calibration: Calibration, metres_per_pixel: float) -> int:
    """Return how many times an image is halved before it is coarser than such a raster."""
    _, finest = _resolution_range(calibration)
    return min(_MAX_LEVEL, int(math.log2(max(1.0, finest * metres_per_pixel))))


def may_be_halved(calibration: Calibration, metres_per_pixel: float) -> bool:
    """Return whether such a raster is nowhere sampled from a level finer than half the image size.

    False for images with an odd side: which of their pixels remain unpaired depends on how they
    are turned.
    """
    coarsest, _ = _resolution_range(calibration)
    even = all(side % 2 == 0 for side in calibration.image_size)
    return even and coarsest * metres_per_pixel >= 2.0 * _ROCKING_SLACK


def _resolution_range(calibration: Calibration) -> tuple[float, float]:
    """Return the lowest and the highest resolution of the floor in an image, pixels per metre."""
    floor = seen_floor(calibration)
    spacing = np.sqrt(floor_sampling(calibration, floor).prod(axis=1))
    return 1.0 / float(spacing.max()), 1.0 / float(spacing.min())
