"""The pictures of keyframes in maps of format version 2 and 3, resampled to those of today.

They were views at half the resolution of those that features were detected in.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.errors import MapError
from slamcli.core.geometry import Grid, invert
from slamcli.core.records import Keyframe

# As that of the pictures themselves [guarded by tests/io/test_map_file.py].
_JPEG_QUALITY = 90
_HALVE = np.diag([0.5, 0.5, 1.0])


def older_size(view: Grid) -> tuple[int, int]:
    """Return the width and height of the pictures, given the grid of the views of features."""
    return -(-view.width // 2), -(-view.height // 2)


def resampled(keyframe: Keyframe, view: Grid, compared: Grid) -> Keyframe:
    """Return a keyframe with its pictures on the grid of the views that are compared today.

    Parameters
    ----------
    keyframe : Keyframe
    view : Grid
        Of the views that features were detected in.
    compared : Grid

    Raises
    ------
    MapError
        When a picture cannot be decoded.
    """
    before_from_now = _HALVE @ view.pixel_from_metres @ invert(compared.pixel_from_metres)
    image = _warped(keyframe, keyframe.image, before_from_now, compared)
    mask = _warped(keyframe, keyframe.mask, before_from_now, compared)
    whole = np.where(mask == 255, np.uint8(255), np.uint8(0))
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return replace(
        keyframe,
        image=np.asarray(cv2.imencode(".jpg", image, quality)[1]).tobytes(),
        mask=np.asarray(cv2.imencode(".png", whole)[1]).tobytes(),
    )


def _warped(
    keyframe: Keyframe, encoded: bytes, before_from_now: Float64Array, grid: Grid
) -> UInt8Array:
    try:
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        picture = None
    if picture is None:
        raise MapError(f"the pictures of its keyframe {keyframe.index} are damaged")
    size, flags = (grid.width, grid.height), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, before_from_now[:2], size, flags=flags), np.uint8)
