"""Obstacles: where two views disagree under the floor's own motion.

An obstacle is shown where the ray past it meets the floor, which differs from view to view. Two
views are compared in small windows, each at the pyramid level that the camera resolves there in
both: finer detail of far floor disagrees in any case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.resolution import floor_sampling
from slamcli.core.geometry import apply_homography, invert
from slamcli.core.records import PyramidLevel
from slamcli.stages.dense import pyramid

# Side of a cell, in pixels of the finest level.
_CELL_PIXELS = 8
# Side of the windows that are compared, in pixels of their own level.
_WINDOW_PIXELS = 5
# A window may be moved by this to agree: errors of motion, calibration and tilt
# [guarded by tests/run/paint/test_obstacles.py].
_SHIFT_PIXELS = 1
# Windows that vary by less than this in both views, or whose variance is less than this many times
# that of the noise, show the camera's noise [guarded by tests/run/paint/test_obstacles.py].
_MIN_DEVIATION_GRAY = 4.0
_MIN_NOISE_VARIANCES = 4.0
# The difference of two windows as a share of their energy: about 1 for unlike ones, 0 for like ones
# [guarded by tests/run/paint/test_obstacles.py].
_MIN_UNLIKE_SHARE = 0.25
# A level is used where the camera's pixels are at most this many of its own.
_MAX_CAMERA_PIXELS = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class ObstacleMask:
    """The cells of a view where another view shows something else.

    Attributes
    ----------
    cells_from_metres : (3, 3) float64
        Robot frame to column and row of a cell; whole numbers are the cells' centres.
    judged : (h, w) bool
        The cells that were compared: both views show more than noise there.
    unlike : (h, w) bool
        The compared cells that differ: an obstacle is there, in this view or in the other.
    """

    cells_from_metres: Float64Array
    judged: BoolArray
    unlike: BoolArray

    def marks(self, points: Float32Array) -> BoolArray:
        """Return which (N, 2) points of the view, metres, lie on an unlike cell."""
        column, row = np.rint(apply_homography(self.cells_from_metres, points)).astype(np.int64).T
        rows, columns = self.unlike.shape
        marked = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        marked[marked] = self.unlike[row[marked], column[marked]]
        return np.asarray(marked)


def find_obstacles(
    levels_a: Sequence[PyramidLevel],
    levels_b: Sequence[PyramidLevel],
    view_a_from_view_b: Float64Array,
    calibration: Calibration,
) -> ObstacleMask:
    """Mark the cells of view a where view b shows something else.

    Parameters
    ----------
    levels_a, levels_b : sequence of PyramidLevel
        From `make_levels`, of views of one resolution.
    view_a_from_view_b : (3, 3) float64
        Metres to metres, of the floor: a motion, or a `PhotometricFit`'s.
    calibration : Calibration
        Of the camera that took both.
    """
    finest = levels_a[0]
    rows, columns = (-(-side // _CELL_PIXELS) for side in finest.image.shape)
    middle = (_CELL_PIXELS - 1) / 2
    pixel_from_cell = np.array(
        [[_CELL_PIXELS, 0.0, middle], [0.0, _CELL_PIXELS, middle], [0.0, 0.0, 1.0]]
    )
    metres_from_cell = invert(finest.pixel_from_metres) @ pixel_from_cell
    row, column = np.indices((rows, columns))
    cells = np.column_stack([column.ravel(), row.ravel()]).astype(np.float64)
    points = apply_homography(metres_from_cell, cells)
    resolved = np.maximum(
        _resolved(calibration, points),
        _resolved(calibration, apply_homography(invert(view_a_from_view_b), points)),
    )
    judged, unlike = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
    least = 0.0
    for a, b in zip(levels_a, levels_b, strict=True):
        most = _MAX_CAMERA_PIXELS * a.metres_per_pixel
        here = (resolved > least) & (resolved <= most)
        least = most
        if not here.any():
            continue
        informative, share = _compare(a, b, view_a_from_view_b)
        at_column, at_row = np.rint(apply_homography(a.pixel_from_metres, points[here])).T
        at_column = np.clip(at_column.astype(np.int64), 0, share.shape[1] - 1)
        at_row = np.clip(at_row.astype(np.int64), 0, share.shape[0] - 1)
        judged[here] = informative[at_row, at_column]
        unlike[here] = judged[here] & (share[at_row, at_column] > _MIN_UNLIKE_SHARE)
    return ObstacleMask(
        invert(metres_from_cell),
        judged.reshape(rows, columns),
        _without_lone_cells(unlike.reshape(rows, columns)),
    )


def _without_lone_cells(unlike: BoolArray) -> BoolArray:
    """Leave out cells without an unlike neighbour: an obstacle is larger than one cell."""
    around = cv2.boxFilter(
        unlike.astype(np.uint8), -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(unlike & (np.asarray(around) > 1))


def _resolved(calibration: Calibration, points: Float64Array) -> Float64Array:
    """Return (N,): metres of floor that one pixel of the camera spans, in its longer direction."""
    return np.asarray(floor_sampling(calibration, points).max(axis=1), np.float64)


def _compare(
    a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array
) -> tuple[BoolArray, Float32Array]:
    """Return which windows of a level are informative, and the share of each that differs.

    The share is of the energy of both windows, at the shift with the least difference: 1 for
    unrelated windows.
    """
    b_pixel_from_a_pixel = (
        b.pixel_from_metres @ invert(view_a_from_view_b) @ invert(a.pixel_from_metres)
    )
    size = (a.detail.shape[1], a.detail.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = np.asarray(cv2.warpPerspective(b.detail, b_pixel_from_a_pixel, size, flags=flags))
    seen = np.asarray(cv2.warpPerspective(b.inside, b_pixel_from_a_pixel, size, flags=flags))
    both = ((seen == 255) & (a.inside == 255)).astype(np.float32)
    first, reach = a.detail * both, _SHIFT_PIXELS
    framed = np.pad(moved * both, reach)
    min_share = np.full(first.shape, np.inf, np.float32)
    min_difference = min_share.copy()
    height, width = first.shape
    for down in range(2 * reach + 1):
        for right in range(2 * reach + 1):
            second = framed[down : down + height, right : right + width]
            energy = _mean(first * first) + _mean(second * second)
            difference = _mean((first - second) ** 2)
            min_share = np.minimum(min_share, difference / np.maximum(energy, np.float32(1e-6)))
            min_difference = np.minimum(min_difference, difference)
    whole = _mean(both) > np.float32(0.999)
    dark = np.asarray(
        cv2.warpPerspective(b.image, b_pixel_from_a_pixel, size, flags=flags), np.uint8
    )
    gains = _mean(pyramid.noise_gain(a.image) ** 2), _mean(pyramid.noise_gain(dark) ** 2)
    # Most of what both see is floor, where the difference is noise.
    noise = (
        float(np.median((min_difference / (gains[0] + gains[1]))[whole])) if whole.any() else 0.0
    )
    informative = np.zeros_like(whole)
    for shown, gain in ((first, gains[0]), (moved * both, gains[1])):
        min_shown = np.maximum(
            _MIN_NOISE_VARIANCES * noise * gain, np.float32(_MIN_DEVIATION_GRAY**2)
        )
        informative |= _variance(shown) > min_shown
    return np.asarray(whole & informative), min_share


def _variance(values: Float32Array) -> Float32Array:
    return np.asarray(_mean(values * values) - _mean(values) ** 2)


def _mean(values: Float32Array) -> Float32Array:
    window = (_WINDOW_PIXELS, _WINDOW_PIXELS)
    return np.asarray(cv2.blur(values, window, borderType=cv2.BORDER_CONSTANT), np.float32)
