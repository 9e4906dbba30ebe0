"""Obstacles for a planner's occupancy grid: cells of the painted map that are not free floor."""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, UInt8Array

# Alpha in a tile's `obstacles` of a permanent obstacle, and of one that was there for some views
# only.
PERMANENT_ALPHA, PASSED_ALPHA = 255, 150
# A wider stripe is a field and not a line [guarded by tests/stages/test_mosaic.py].
_MAX_LINE_METRES = 0.08
_MIN_LINE_CONTRAST_GRAY = 40.0


def line_cells(image: UInt8Array, mask: UInt8Array, metres_per_pixel: float) -> BoolArray:
    """Return (h, w): where an image shows a painted line, brighter than the floor beside it.

    By the white top-hat (Serra, Image Analysis and Mathematical Morphology, 1982) over the widest
    line, and Otsu's threshold, at least some contrast.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    side = max(3, round(_MAX_LINE_METRES / metres_per_pixel) * 2 + 1)
    # Unseen is taken as bright, so that the border of what was seen is no line.
    filled = np.where(mask > 0, gray, np.uint8(255))
    ground = cv2.morphologyEx(filled, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    above = np.where(mask > 0, cv2.subtract(gray, ground), np.uint8(0)).astype(np.uint8)
    seen = above[mask > 0]
    if seen.size == 0:
        return np.zeros(mask.shape, np.bool_)
    threshold, _ = cv2.threshold(seen[None], 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    return np.greater(above, max(float(threshold), _MIN_LINE_CONTRAST_GRAY))
