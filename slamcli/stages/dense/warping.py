"""One view's pictures warped onto the pixels of another under a motion."""

from __future__ import annotations

import cv2

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import invert
from slamcli.core.records import PyramidLevel


def warp_onto(
    a: PyramidLevel,
    b: PyramidLevel,
    view_a_from_view_b: Float64Array,
    *pictures: cv2.typing.MatLike,
) -> list[cv2.typing.MatLike]:
    """Return pictures of level b, such as its mask, on the pixels of level a; 0 outside.

    Parameters
    ----------
    a, b : PyramidLevel
    view_a_from_view_b : (3, 3) float64
        Metres to metres.
    *pictures : (h, w) uint8 or float32
        On the pixels of b.
    """
    b_from_a_pixel = invert(view_a_from_view_b) @ invert(a.pixel_from_metres)
    b_pixel_from_a_pixel = b.pixel_from_metres @ b_from_a_pixel
    size = (a.image.shape[1], a.image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return [
        cv2.warpPerspective(picture, b_pixel_from_a_pixel, size, flags=flags)
        for picture in pictures
    ]
