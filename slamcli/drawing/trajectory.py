"""Drawing of a trajectory over the map, with a scale bar."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Unit
from slamcli.core.geometry import Grid, apply_homography
from slamcli.core.records import PoseEstimate

MAX_SIDE_PIXELS = 1600
_MARGIN_SHARE = 0.04
_PATH_COLOUR = (60, 60, 230)
_START_COLOUR = (70, 170, 40)
_TEXT_COLOUR = (30, 30, 30)
_BACKGROUND_GRAY = 245
_MAX_LABELS = 12


def draw_trajectory(
    image: UInt8Array,
    mask: UInt8Array,
    grid: Grid,
    estimates: Sequence[PoseEstimate],
    unit: Unit,
) -> UInt8Array:
    """Return the map, paled, with the robot's path, some frame numbers, the start and a scale bar.

    Parameters
    ----------
    image, mask, grid : (h, w, 3) uint8 BGR, (h, w) uint8, Grid
        The map of one fragment; unseen where the mask is 0.
    estimates : sequence of PoseEstimate
        The frames placed in it, in order.
    """
    poses = [e.map_from_robot for e in estimates if e.map_from_robot is not None]
    positions = np.array([(pose.x, pose.y) for pose in poses])
    view_grid = _grid_around(np.vstack([positions, grid.corners]))
    canvas = _paled(image, mask, grid, view_grid)
    pixels = apply_homography(view_grid.pixel_from_metres, positions)
    points = np.round(pixels).astype(np.int32)
    cv2.polylines(
        canvas,
        [points[:, None]],
        isClosed=False,
        color=_PATH_COLOUR,
        thickness=2,
        lineType=cv2.LINE_AA,
    )
    arrow = 0.03 * max(view_grid.width, view_grid.height)
    step = max(1, math.ceil(len(estimates) / _MAX_LABELS))
    for number, (estimate, pose, pixel) in enumerate(zip(estimates, poses, pixels, strict=True)):
        start = _rounded(pixel)
        cv2.circle(canvas, start, 3, _PATH_COLOUR, -1, cv2.LINE_AA)
        if number % step == 0:
            ahead = pixel + arrow * np.array([math.cos(pose.theta), -math.sin(pose.theta)])
            cv2.arrowedLine(canvas, start, _rounded(ahead), _PATH_COLOUR, 2, cv2.LINE_AA)
            _write(canvas, str(estimate.index), (start[0] + 6, start[1] - 6))
    cv2.circle(canvas, _rounded(pixels[0]), 7, _START_COLOUR, 3, cv2.LINE_AA)
    _draw_scale_bar(canvas, view_grid, unit)
    return canvas


def _grid_around(points: Float64Array) -> Grid:
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN_SHARE * float((high - low).max())
    corners = np.array([low - margin, high + margin])
    return Grid.covering(corners, float(np.ptp(corners, axis=0).max()) / MAX_SIDE_PIXELS)


def _paled(image: UInt8Array, mask: UInt8Array, grid: Grid, view_grid: Grid) -> UInt8Array:
    """Return the map at the scale of the drawing, paled so that lines on it are visible."""
    visible = np.full_like(image, _BACKGROUND_GRAY)
    cv2.copyTo(image, mask, visible)
    factor = grid.metres_per_pixel / view_grid.metres_per_pixel
    size = (max(1, round(grid.width * factor)), max(1, round(grid.height * factor)))
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    small = cv2.resize(visible, size, interpolation=method)
    pale = cv2.addWeighted(small, 0.6, np.full_like(small, _BACKGROUND_GRAY), 0.4, 0.0)
    canvas = np.full((view_grid.height, view_grid.width, 3), _BACKGROUND_GRAY, np.uint8)
    row = round((view_grid.y_max - grid.y_max) / view_grid.metres_per_pixel)
    column = round((grid.x_min - view_grid.x_min) / view_grid.metres_per_pixel)
    part = pale[: canvas.shape[0] - row, : canvas.shape[1] - column]
    canvas[row : row + part.shape[0], column : column + part.shape[1]] = part
    return canvas


def _draw_scale_bar(canvas: UInt8Array, grid: Grid, unit: Unit) -> None:
    widest = 0.25 * grid.width * grid.metres_per_pixel
    power = 10.0 ** math.floor(math.log10(widest))
    length = power * max(step for step in (1, 2, 5) if step * power <= widest)
    left, bottom = 20, canvas.shape[0] - 20
    right = left + round(length / grid.metres_per_pixel)
    cv2.line(canvas, (left, bottom), (right, bottom), _TEXT_COLOUR, 3)
    for column in (left, right):
        cv2.line(canvas, (column, bottom - 6), (column, bottom + 6), _TEXT_COLOUR, 2)
    _write(canvas, f"{length:g} {unit}", (left, bottom - 12))


def _write(canvas: UInt8Array, text: str, position: tuple[int, int]) -> None:
    """Write dark on a light halo, readable on any floor."""
    halo = (_BACKGROUND_GRAY,) * 3
    cv2.putText(canvas, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.6, halo, 4, cv2.LINE_AA)
    cv2.putText(canvas, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _TEXT_COLOUR, 1, cv2.LINE_AA)


def _rounded(pixel: Float64Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
