"""One view's pictures warped onto the pixels of another under a motion."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import invert
from slamcli.core.records import PyramidLevel

# What is not seen is warped with the picture: no share of it is too small to show.
_NOT_SEEN = np.float32(np.nan)


def warp_onto(
    a: PyramidLevel,
    b: PyramidLevel,
    view_a_from_view_b: Float64Array,
    picture: UInt8Array | Float32Array,
    mask: UInt8Array,
) -> tuple[Float32Array, BoolArray]:
    """Return a picture of level b on the pixels of level a, and where all of a pixel is seen.

    Elsewhere the picture is 0.

    Parameters
    ----------
    a, b : PyramidLevel
    view_a_from_view_b : (3, 3) float64
        Metres to metres.
    picture : (h, w) uint8 or float32
        On the pixels of b.
    mask : (h, w) uint8
        255 where it is seen.
    """
    b_from_a_pixel = invert(view_a_from_view_b) @ invert(a.pixel_from_metres)
    b_pixel_from_a_pixel = b.pixel_from_metres @ b_from_a_pixel
    size = (a.image.shape[1], a.image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    # One warp of floats is faster than two of bytes.
    marked = np.full(mask.shape, _NOT_SEEN)
    whole = (mask == 255).view(np.uint8)
    cv2.copyTo(picture.astype(np.float32, copy=False), whole, marked)
    moved = np.asarray(
        cv2.warpPerspective(marked, b_pixel_from_a_pixel, size, flags=flags, borderValue=math.nan),
        np.float32,
    )
    seen = ~np.isnan(moved)
    cv2.patchNaNs(moved, 0.0)
    return moved, seen
