"""Drawing of a calibration: the photo with its usable region, beside the bird's-eye view."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.camera.lens import distort_points, undistort_points
from slamcli.core.geometry import Grid, apply_homography
from slamcli.core.names import readable
from slamcli.core.records import View

PANEL_HEIGHT_PIXELS = 760
_MAX_PHOTO_WIDTH_PIXELS = 1150
_MARGIN_PIXELS = 24
_AXIS_PIXELS = 62
_CAPTION_LINE_PIXELS = 26
_BACKGROUND = (250, 250, 250)
_INK = (40, 40, 40)
_SQUARE = (60, 60, 235)
_HORIZON = (230, 150, 30)
_LIMIT = (40, 190, 240)
_GRID = (150, 120, 60)
_HAZE = (190.0, 175.0, 175.0)
_UNSEEN_GRAY = 235
_SUBPIXEL_BITS = 4


def birdseye_grid(calibration: Calibration, corners: Float64Array) -> Grid:
    """Return the raster, robot frame, that shows the kept floor and the target in one panel.

    Parameters
    ----------
    calibration : Calibration
    corners : (N, 2) float64, metres
        Of the target.
    """
    points = np.vstack([footprint_hull(calibration), corners])
    margin = 0.03 * float(np.ptp(points, axis=0).max())
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    ahead, sideways = high - low
    inner = PANEL_HEIGHT_PIXELS - _AXIS_PIXELS
    return Grid.covering([low, high], float(max(ahead / inner, sideways / (1.6 * inner))))


def draw_calibration(
    photo: UInt8Array,
    outline: Float64Array,
    calibration: Calibration,
    birdseye: View,
    caption: Sequence[str],
) -> UInt8Array:
    """Return the photo, unused pixels shaded, beside the bird's-eye view under a metric grid.

    Parameters
    ----------
    photo : (H, W, 3) uint8, BGR
    outline : (N, 2) float64
        Pixels of the photo: the corners of the target, in order.
    calibration : Calibration
    birdseye : View
        BGR, on `birdseye_grid`; what lies past the far limit is shaded here.
    caption : lines of text below
    """
    left = _draw_photo(photo, outline, calibration)
    right = _draw_floor(outline, calibration, birdseye)
    height = max(left.shape[0], right.shape[0])
    text_height = len(caption) * _CAPTION_LINE_PIXELS
    margin = _MARGIN_PIXELS
    shape = (
        height + text_height + 3 * margin,
        left.shape[1] + right.shape[1] + 3 * margin,
        3,
    )
    canvas = np.full(shape, _BACKGROUND, dtype=np.uint8)
    column = 2 * margin + left.shape[1]
    canvas[margin : margin + left.shape[0], margin : margin + left.shape[1]] = left
    canvas[margin : margin + right.shape[0], column : column + right.shape[1]] = right
    for number, line in enumerate(caption):
        row = height + 2 * margin + number * _CAPTION_LINE_PIXELS + 16
        _write(canvas, line, (margin, row))
    return canvas


def _draw_photo(photo: UInt8Array, outline: Float64Array, calibration: Calibration) -> UInt8Array:
    """Return the photo, unused pixels shaded, with the target, the far limit and the horizon."""
    height, width = photo.shape[:2]
    factor = min(PANEL_HEIGHT_PIXELS / height, _MAX_PHOTO_WIDTH_PIXELS / width)
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    size = (round(width * factor), round(height * factor))
    canvas = np.asarray(cv2.resize(photo, size, interpolation=method), dtype=np.uint8)
    kept = _kept_pixels(calibration, size)
    canvas = _hazed(canvas, ~kept)
    edges, _ = cv2.findContours(kept.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas, edges, -1, _LIMIT, 2, cv2.LINE_AA)
    horizon = _horizon(calibration)
    if len(horizon):
        _polyline(canvas, horizon * factor, _HORIZON, closed=False)
        column, row = horizon[len(horizon) // 8] * factor
        _label(canvas, "horizon", (round(column), max(24, round(row) - 12)))
    _polyline(canvas, outline * factor, _SQUARE, closed=True)
    for corner in outline * factor:
        _ring(canvas, corner)
    _label(canvas, "kept", _label_position(kept))
    return canvas


def _draw_floor(outline: Float64Array, calibration: Calibration, birdseye: View) -> UInt8Array:
    """Return the view turned so that the robot faces up the page, under the metric grid."""
    grid = birdseye.grid
    lattice = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    metres = apply_homography(grid.metres_from_pixel, np.dstack(lattice))
    kept = np.hypot(metres[..., 0], metres[..., 1]) <= calibration.max_range_metres
    view = _hazed(birdseye.image, ~kept)
    view[birdseye.mask == 0] = _UNSEEN_GRAY
    floor = np.ascontiguousarray(np.rot90(view))
    canvas = np.full(
        (floor.shape[0] + _AXIS_PIXELS, floor.shape[1] + _AXIS_PIXELS, 3), _BACKGROUND, np.uint8
    )
    canvas[: floor.shape[0], _AXIS_PIXELS:] = floor
    part = canvas[: floor.shape[0], _AXIS_PIXELS:]
    step = _round_step(max(grid.x_max - grid.x_min, grid.y_max - grid.y_min) / 7.0)
    for x in _multiples(grid.x_min, grid.x_max, step):
        ends = _page_pixels(grid, [(x, grid.y_min), (x, grid.y_max)])
        _polyline(part, ends, _GRID, closed=False, thickness=1)
        _write(canvas, f"{x:g}", (8, round(float(ends[0, 1])) + 6))
    for y in _multiples(grid.y_min, grid.y_max, step):
        ends = _page_pixels(grid, [(grid.x_min, y), (grid.x_max, y)])
        _polyline(part, ends, _GRID, closed=False, thickness=1)
        column = _AXIS_PIXELS + round(float(ends[0, 0]))
        _write(canvas, f"{y:g}", (column - 14, floor.shape[0] + 24))
    undistorted = undistort_points(calibration, outline)
    corners = apply_homography(calibration.robot_from_image, undistorted)
    _polyline(part, _page_pixels(grid, corners), _SQUARE, closed=True)
    cv2.rectangle(part, (0, 0), (part.shape[1] - 1, part.shape[0] - 1), _GRID, 1)
    text = f"x ahead (up) and y left, in metres; a line every {step:g} m"
    _write(canvas, text, (_AXIS_PIXELS, floor.shape[0] + 50))
    return canvas


def _hazed(image: UInt8Array, where: BoolArray) -> UInt8Array:
    hazed = image.copy()
    hazed[where] = (0.45 * image[where] + 0.55 * np.array(_HAZE)).astype(np.uint8)
    return hazed


def _kept_pixels(calibration: Calibration, size: tuple[int, int]) -> BoolArray:
    """Return (h, w), at the drawn size, whether a pixel shows floor within the far limit."""
    width, height = calibration.image_size
    columns, rows = np.meshgrid(
        np.linspace(0, width - 1, size[0]), np.linspace(0, height - 1, size[1])
    )
    points = np.column_stack([columns.ravel(), rows.ravel()])
    pixels = undistort_points(calibration, points)
    depth = np.column_stack([pixels, np.ones(len(pixels))]) @ calibration.robot_from_image[2]
    floor = apply_homography(calibration.robot_from_image, pixels)
    with np.errstate(invalid="ignore"):
        near = np.hypot(floor[:, 0], floor[:, 1]) <= calibration.max_range_metres
    kept: BoolArray = (near & (depth > 0)).reshape(size[1], size[0])
    return kept


def _horizon(calibration: Calibration) -> Float64Array:
    """Return (N, 2) pixels of the photo along the floor's line at infinity, where it shows."""
    a, b, c = calibration.robot_from_image[2]
    width, height = calibration.image_size
    if abs(b) < 1e-12 * abs(c):
        return np.empty((0, 2))
    columns = np.linspace(0.0, width - 1.0, 65)
    line = np.column_stack([columns, -(a * columns + c) / b])
    # Far outside the image a lens polynomial is not valid.
    near = (line[:, 1] > -0.5 * height) & (line[:, 1] < 1.5 * height)
    pixels = distort_points(calibration, line[near])
    return pixels[(pixels[:, 1] >= 0) & (pixels[:, 1] < height)]


def _page_pixels(grid: Grid, points: Float64Array | Sequence[tuple[float, float]]) -> Float64Array:
    """Map floor metres to pixels of the view turned by a quarter counter-clockwise."""
    pixels = apply_homography(grid.pixel_from_metres, points)
    return np.column_stack([pixels[:, 1], grid.width - 1 - pixels[:, 0]])


def _label_position(kept: BoolArray) -> tuple[int, int]:
    rows = np.flatnonzero(kept.any(axis=1))
    if not len(rows):
        return 8, 20
    row = int(rows[-1]) - 12
    return int(np.flatnonzero(kept[max(row, 0)])[0]) + 12 if kept[max(row, 0)].any() else 8, row


def _multiples(low: float, high: float, step: float) -> list[float]:
    first, last = math.ceil(low / step), math.floor(high / step)
    return [round(number * step, 6) + 0.0 for number in range(first, last + 1)]


def _round_step(least: float) -> float:
    power = 10.0 ** math.floor(math.log10(least))
    return power * min(factor for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= least)


def _polyline(
    canvas: UInt8Array,
    points: Float64Array,
    colour: tuple[int, int, int],
    *,
    closed: bool,
    thickness: int = 2,
) -> None:
    fixed = np.round(points * 2**_SUBPIXEL_BITS).astype(np.int32)
    cv2.polylines(canvas, [fixed[:, None]], closed, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _ring(canvas: UInt8Array, pixel: Float64Array) -> None:
    column, row = (round(float(value) * 2**_SUBPIXEL_BITS) for value in pixel)
    radius = 8 * 2**_SUBPIXEL_BITS
    cv2.circle(canvas, (column, row), radius, _SQUARE, 2, cv2.LINE_AA, _SUBPIXEL_BITS)


def _label(canvas: UInt8Array, text: str, position: tuple[int, int]) -> None:
    """Write on a light tag, readable on any floor."""
    text = readable(text)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    column, row = position
    corners = (column - 4, row - height - 4), (column + width + 4, row + below + 2)
    cv2.rectangle(canvas, *corners, _BACKGROUND, -1)
    _write(canvas, text, position)


def _write(canvas: UInt8Array, text: str, position: tuple[int, int]) -> None:
    cv2.putText(canvas, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
