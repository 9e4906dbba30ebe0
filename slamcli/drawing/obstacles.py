"""Drawing of obstacles: a view with the cells of obstacles tinted red."""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, UInt8Array

_TINT = np.array([40.0, 40.0, 255.0])
_SHARE = 0.5


def draw_obstacles(
    image: UInt8Array, cells: BoolArray, cells_from_pixel: Float64Array
) -> UInt8Array:
    """Return the image with the marked cells tinted.

    Parameters
    ----------
    image : (h, w, 3) uint8 BGR
    cells : (rows, columns) bool
    cells_from_pixel : (3, 3) float64
        Pixels of the image to column and row of a cell, whole at its centre.
    """
    marked = cv2.warpPerspective(
        cells.astype(np.uint8),
        cells_from_pixel,
        (image.shape[1], image.shape[0]),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )
    tinted = (1.0 - _SHARE) * image + _SHARE * _TINT
    return np.where((marked > 0)[..., None], tinted, image).astype(np.uint8)
