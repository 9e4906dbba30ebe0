"""How well two views agree under a motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from slamcli.core.geometry import apply_homography, invert

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.geometry import Pose2
    from slamcli.core.records import DenseLevel, View

_LEAST_SHARED_PIXELS = 200
_OVERLAP_STEP = 16


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How two overlapping views compare under a motion.

    Attributes
    ----------
    correlation : float
        Zero-mean normalised cross-correlation of the overlap, in [-1, 1].
    overlap : float
        Share of the smaller view's floor that both see.
    """

    correlation: float
    overlap: float


def overlap(view_a: View, view_b: View, a_from_b: Pose2) -> float:
    """Return about which share of view b's floor view a sees too, from every 16th pixel."""
    rows, columns = np.nonzero(view_b.mask[::_OVERLAP_STEP, ::_OVERLAP_STEP])
    pixels_b = _OVERLAP_STEP * np.column_stack([columns, rows])
    points_b = apply_homography(view_b.grid.metres_from_pixel, pixels_b)
    pixels_a = apply_homography(view_a.grid.pixel_from_metres, a_from_b.apply(points_b))
    column, row = np.round(pixels_a).astype(np.int64).T
    inside = (column >= 0) & (row >= 0)
    inside &= (column < view_a.grid.width) & (row < view_a.grid.height)
    shared = np.count_nonzero(view_a.mask[row[inside], column[inside]])
    return shared / max(1, len(points_b))


def agreement(a: DenseLevel, b: DenseLevel, view_a_from_view_b: NDArray[np.float64]) -> Agreement:
    """Correlate the overlap of two views, at one level of their pyramids.

    Parameters
    ----------
    a, b : DenseLevel
    view_a_from_view_b : (3, 3) float64
        Metres to metres: a motion, or a `Refinement`'s.
    """
    b_from_a_pixel = invert(view_a_from_view_b) @ invert(a.pixel_from_metres)
    b_pixel_from_a_pixel = b.pixel_from_metres @ b_from_a_pixel
    size = (a.image.shape[1], a.image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpPerspective(b.image, b_pixel_from_a_pixel, size, flags=flags)
    seen = cv2.warpPerspective(b.mask, b_pixel_from_a_pixel, size, flags=flags)
    both = (np.asarray(seen) == 255) & (a.mask == 255)
    smaller = int(min(np.count_nonzero(a.mask == 255), np.count_nonzero(b.mask == 255)))
    shared = int(np.count_nonzero(both))
    if shared < _LEAST_SHARED_PIXELS:
        return Agreement(math.nan, shared / max(1, smaller))
    values_a = a.image[both].astype(np.float32)
    values_b = np.asarray(moved)[both].astype(np.float32)
    values_a -= values_a.mean()
    values_b -= values_b.mean()
    norm = math.sqrt(float(values_a @ values_a) * float(values_b @ values_b))
    correlation = float(values_a @ values_b) / norm if norm > 0 else 0.0
    return Agreement(correlation, shared / smaller)
