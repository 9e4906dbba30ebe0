"""Marks: spots of the floor that one of two motions explains and the other does not.

On a floor that looks like itself nearly all pixels fit two motions alike, and only a scratch, a
stain or a character distinguishes them. Two views of one spot differ by noise, by a fraction of a
pixel and in sharpness (the far part of a view is blurred); a mark that only one of them shows
differs by more than any of these explain.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import PyramidLevel
from slamcli.stages.dense.lucas_kanade import refine
from slamcli.stages.dense.warping import warp_onto

# Side of the neighbourhood that is compared, pixels of the finest level, and what neighbourhoods of
# the mask's border are left out by.
_SIDE_PIXELS = 5
_BORDER_PIXELS = 7
# Standard deviation, pixels, of the blur by which either view may be less sharp
# [guarded by benchmarks/tiles.py: without it grout lines of a view's far part count as marks].
_BLUR_PIXELS = 1.0
_SHIFTS = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))
# A spot is explained when its mean squared difference is below the first pair of numbers, times the
# noise and times its contrast, and unexplained above the second
# [guarded by benchmarks/tiles.py: tiles without marks 0 to 2 spots, with 3 marks a tile 2 to 14].
_EXPLAINED = (2.0, 0.06)
_UNEXPLAINED = (8.0, 0.25)
_MIN_NOISE = 0.5
# A mark of a few pixels leaves about as many whose neighbourhood it dominates.
_MIN_SPOT_PIXELS = 12
_AROUND = np.ones((3, 3), np.uint8)


def distinguishing_marks(
    a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array, rival: Float64Array
) -> tuple[int, int]:
    """Return the number of marks that a motion alone explains, and that its rival alone explains.

    Parameters
    ----------
    a, b : PyramidLevel
        The finest of each pyramid.
    view_a_from_view_b, rival : (3, 3) float64
        Metres to metres.
    """
    first, second = _compare(a, b, view_a_from_view_b), _compare(a, b, rival)
    both = first.inner & second.inner
    if not both.any():
        return 0, 0
    noise = first.noise(both)
    return (
        _spots(both & first.explained(noise) & second.unexplained(noise)),
        _spots(both & second.explained(noise) & first.unexplained(noise)),
    )


def own_marks(
    levels: Sequence[PyramidLevel], periods: Float64Array, calibration: Calibration
) -> BoolArray:
    """Return the pixels of a view that its own pattern explains in no direction, one period on.

    Parameters
    ----------
    levels : sequence of PyramidLevel
        The pyramid of the view, from fine to coarse.
    periods : (K, 2) float64
        Shifts, metres in the robot's axes, by which the view looks like itself.
    calibration : Calibration

    Returns
    -------
    (h, w) bool
        At the finest level: what repeats under none of the periods.
    """
    shape = levels[0].detail.shape
    compared, explained = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    for x, y in periods:
        shift = refine(levels, levels, Pose2(float(x), float(y)), calibration, 0.0)
        if shift is None:
            continue
        for motion in (shift.view_a_from_view_b, invert(shift.view_a_from_view_b)):
            apart = _compare(levels[0], levels[0], motion)
            if apart.inner.any():
                compared |= apart.inner
                explained |= apart.inner & ~apart.unexplained(apart.noise(apart.inner))
    return np.asarray(compared & ~explained)


def count_explained(
    a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array, marks: BoolArray
) -> tuple[int, int]:
    """Return how many marks of view a view b shows where a motion puts them, and how many not.

    Parameters
    ----------
    a, b : PyramidLevel
        The finest of each pyramid.
    view_a_from_view_b : (3, 3) float64
        Metres to metres.
    marks : (h, w) bool
        Those of view a, as `own_marks` returns them.
    """
    comparison = _compare(a, b, view_a_from_view_b)
    if not comparison.inner.any():
        return 0, 0
    noise = comparison.noise(comparison.inner)
    grown = cv2.dilate((marks & comparison.inner).astype(np.uint8), _AROUND)
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(grown)
    pro = np.bincount(labels[comparison.explained(noise)], minlength=count)
    contra = np.bincount(labels[comparison.unexplained(noise)], minlength=count)
    large = statistics[:, cv2.CC_STAT_AREA] >= _MIN_SPOT_PIXELS
    # The first label is the background.
    large[0] = False
    return int(np.count_nonzero(large & (pro > contra))), int(
        np.count_nonzero(large & (contra > pro))
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """Two views under a motion, compared around every pixel of the first.

    Attributes
    ----------
    inner : (h, w) bool
        Where both show the floor, away from the masks' borders.
    difference, contrast : (h, w) float32
        Mean squares about a pixel: of the least difference, and of the larger detail.
    """

    inner: BoolArray
    difference: Float32Array
    contrast: Float32Array

    def noise(self, where: BoolArray) -> float:
        """Return the usual difference in a part of the views, which is not empty."""
        return max(float(np.median(self.difference[where])), _MIN_NOISE)

    def explained(self, noise: float) -> BoolArray:
        """Return where noise, a small shift and a little blur explain the difference."""
        return np.asarray(self.difference < _EXPLAINED[0] * noise + _EXPLAINED[1] * self.contrast)

    def unexplained(self, noise: float) -> BoolArray:
        """Return where they are far from explaining it."""
        limit = _UNEXPLAINED[0] * noise + _UNEXPLAINED[1] * self.contrast
        return np.asarray(self.difference > limit)


def _compare(a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array) -> _Comparison:
    moved, inside = warp_onto(a, b, view_a_from_view_b, b.detail, b.inside)
    seen = inside & (a.inside == 255)
    border = np.ones((2 * _BORDER_PIXELS + 1, 2 * _BORDER_PIXELS + 1), np.uint8)
    inner = np.asarray(cv2.erode(seen.view(np.uint8), border)) > 0
    contrast = np.maximum(_mean(a.detail * a.detail), _mean(moved * moved))
    return _Comparison(inner, _difference(a.detail, moved), contrast)


def _difference(detail: Float32Array, moved: Float32Array) -> Float32Array:
    """Return the least mean squared difference, over small shifts and differences of sharpness."""
    least = None
    for first, second in _sharpnesses(detail, moved):
        for right, down in _SHIFTS:
            shift = np.array([[1.0, 0.0, right], [0.0, 1.0, down]], np.float32)
            size = (second.shape[1], second.shape[0])
            shifted = cv2.warpAffine(
                second, shift, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
            )
            apart = cv2.subtract(first, shifted)
            mean = cv2.blur(cv2.multiply(apart, apart), (_SIDE_PIXELS, _SIDE_PIXELS))
            least = mean if least is None else cv2.min(least, mean)
    return np.asarray(least, np.float32)


def _sharpnesses(
    detail: Float32Array, moved: Float32Array
) -> Iterator[tuple[Float32Array, Float32Array]]:
    yield detail, moved
    yield np.asarray(cv2.GaussianBlur(detail, (0, 0), _BLUR_PIXELS), np.float32), moved
    yield detail, np.asarray(cv2.GaussianBlur(moved, (0, 0), _BLUR_PIXELS), np.float32)


def _mean(values: Float32Array) -> Float32Array:
    return np.asarray(cv2.blur(values, (_SIDE_PIXELS, _SIDE_PIXELS)), np.float32)


def _spots(marked: BoolArray) -> int:
    """Return the number of connected spots that are large enough."""
    grown = cv2.dilate(marked.astype(np.uint8), _AROUND)
    _, _, statistics, _ = cv2.connectedComponentsWithStats(grown)
    return int(np.count_nonzero(statistics[1:, cv2.CC_STAT_AREA] >= _MIN_SPOT_PIXELS))
