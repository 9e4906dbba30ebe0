"""Drawing of a trajectory over the map: axes with lengths, the path by its sigma, and a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Unit
from slamcli.core.geometry import Grid, apply_homography, covariance_in_map
from slamcli.core.records import PoseEstimate

MAX_SIDE_PIXELS = 1600
_MARGIN_SHARE = 0.04
_PATH_COLOUR = (60, 60, 230)
_GAP_COLOUR = (40, 40, 220)
_START_COLOUR = (70, 170, 40)
_TEXT_COLOUR = (30, 30, 30)
_BACKGROUND_GRAY = 245
_MAX_LABELS = 12
# Around the map: room for the numbers of the axes, and below them for the legend.
_LEFT, _RIGHT, _TOP, _AXIS, _LEGEND = 78, 16, 14, 48, 44
_TICK_PIXELS, _TICKS = 7, 8
_DASH_PIXELS = 7.0
_BAR_PIXELS, _BAR_HEIGHT = 160, 14
# The colour bar ends at this share of the sigmas: a few large ones would hide all others.
_BAR_QUANTILE = 0.98


def draw_trajectory(
    image: UInt8Array,
    mask: UInt8Array,
    grid: Grid,
    estimates: Sequence[PoseEstimate],
    unit: Unit,
) -> UInt8Array:
    """Return the map, paled, with axes, and on it the robot's path with some frame numbers.

    The path has the colour of its position's sigma, as far as that is known. An arrow points where
    the robot looks, ahead. Where frames were lost between two others the path is dashed.

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
    sigmas = np.array([_sigma(estimate) for estimate in estimates])
    colours, limit = _path_colours(sigmas)
    gap = _draw_path(canvas, estimates, pixels, colours)
    arrow = 0.03 * max(view_grid.width, view_grid.height)
    step = max(1, math.ceil(len(estimates) / _MAX_LABELS))
    for pixel, colour in zip(pixels, colours, strict=True):
        cv2.circle(canvas, _rounded(pixel), 4, colour, -1, cv2.LINE_AA)
    # On top of the path, which is denser than an arrow is long.
    labelled = list(zip(estimates, poses, pixels, strict=True))[::step]
    for estimate, pose, pixel in labelled:
        start = _rounded(pixel)
        ahead = pixel + arrow * np.array([math.cos(pose.theta), -math.sin(pose.theta)])
        cv2.arrowedLine(canvas, start, _rounded(ahead), _TEXT_COLOUR, 2, cv2.LINE_AA)
        _write(canvas, str(estimate.index), (start[0] + 6, start[1] - 6))
    cv2.circle(canvas, _rounded(pixels[0]), 9, _START_COLOUR, 3, cv2.LINE_AA)
    framed = _with_axes(canvas, view_grid, unit)
    _draw_legend(framed, limit, unit, gap=gap)
    return framed


def _sigma(estimate: PoseEstimate) -> float:
    """Return one standard deviation of a position, in the map; nan where it is not known."""
    if estimate.map_from_robot is None or estimate.covariance is None:
        return math.nan
    variances = np.diag(covariance_in_map(estimate.map_from_robot, estimate.covariance))
    return math.sqrt(max(0.0, float(variances[:2].sum())))


def _path_colours(sigmas: Float64Array) -> tuple[list[tuple[int, int, int]], float | None]:
    """Return each pose's colour, and the sigma at the end of the colour bar; None without any."""
    known = sigmas[np.isfinite(sigmas)]
    if not known.size or known.max() <= 0.0:
        return [_PATH_COLOUR] * len(sigmas), None
    limit = max(float(np.quantile(known, _BAR_QUANTILE)), 1e-9 * float(known.max()))
    share = np.nan_to_num(np.clip(sigmas / limit, 0.0, 1.0), nan=1.0)
    bar = _colour_bar(np.rint(255.0 * share).astype(np.uint8))
    return [(int(b), int(g), int(r)) for b, g, r in bar], limit


def _colour_bar(levels: UInt8Array) -> UInt8Array:
    """Return (N, 3) BGR of levels: dark where the sigma is small."""
    return np.asarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_VIRIDIS)[:, 0], np.uint8)


def _draw_path(
    canvas: UInt8Array,
    estimates: Sequence[PoseEstimate],
    pixels: Float64Array,
    colours: Sequence[tuple[int, int, int]],
) -> bool:
    """Draw lines between poses, dashed where frames between them are lost; return if any is."""
    steps = list(zip(pairwise(estimates), pairwise(pixels), colours[1:], strict=True))
    gaps = [second.index - first.index > 1 for (first, second), _, _ in steps]
    for (_, (begin, end), colour), gap in zip(steps, gaps, strict=True):
        if gap:
            _dashed(canvas, begin, end)
            continue
        ends = _rounded(begin), _rounded(end)
        cv2.line(canvas, *ends, (255, 255, 255), 6, cv2.LINE_AA)
        cv2.line(canvas, *ends, colour, 3, cv2.LINE_AA)
    return any(gaps)


def _dashed(canvas: UInt8Array, begin: Float64Array, end: Float64Array) -> None:
    count = max(1, int(float(np.linalg.norm(end - begin)) / (2.0 * _DASH_PIXELS)))
    for number in range(count):
        first, last = (begin + (end - begin) * (number + part) / count for part in (0.0, 0.5))
        cv2.line(canvas, _rounded(first), _rounded(last), _GAP_COLOUR, 2, cv2.LINE_AA)


def _with_axes(canvas: UInt8Array, grid: Grid, unit: Unit) -> UInt8Array:
    """Return the canvas within a frame that has ticks at round lengths of the map's x and y."""
    height, width = canvas.shape[:2]
    framed = np.full(
        (height + _TOP + _AXIS + _LEGEND, width + _LEFT + _RIGHT, 3), _BACKGROUND_GRAY, np.uint8
    )
    framed[_TOP : _TOP + height, _LEFT : _LEFT + width] = canvas
    cv2.rectangle(framed, (_LEFT, _TOP), (_LEFT + width, _TOP + height), _TEXT_COLOUR, 1)
    step = _round_length(max(width, height) * grid.metres_per_pixel / _TICKS)
    bottom = _TOP + height
    for x in _multiples(grid.x_min, grid.x_max, step):
        column = _LEFT + round((x - grid.x_min) / grid.metres_per_pixel)
        cv2.line(framed, (column, bottom), (column, bottom + _TICK_PIXELS), _TEXT_COLOUR, 1)
        _write(framed, f"{x:g}", (column - 8 * len(f"{x:g}") // 2, bottom + 22), 0.45)
    for y in _multiples(grid.y_min, grid.y_max, step):
        row = _TOP + round((grid.y_max - y) / grid.metres_per_pixel)
        cv2.line(framed, (_LEFT - _TICK_PIXELS, row), (_LEFT, row), _TEXT_COLOUR, 1)
        _write(framed, f"{y:g}", (_LEFT - 12 - 9 * len(f"{y:g}"), row + 5), 0.45)
    _write(framed, f"x ({unit})", (_LEFT + width // 2 - 20, bottom + 42), 0.5)
    _write(framed, f"y ({unit})", (6, _TOP + 14), 0.5)
    return framed


def _round_length(length: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is no longer."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9))


def _multiples(low: float, high: float, step: float) -> list[float]:
    numbers = range(math.ceil(low / step), math.floor(high / step) + 1)
    return [round(number * step, 12) for number in numbers]


def _draw_legend(framed: UInt8Array, limit: float | None, unit: Unit, *, gap: bool) -> None:
    """Write below the axes what marks and colours mean."""
    row, left = framed.shape[0] - 18, _LEFT
    cv2.circle(framed, (left + 8, row - 5), 8, _START_COLOUR, 3, cv2.LINE_AA)
    left = _write(framed, "start", (left + 24, row), 0.5) + 24
    cv2.arrowedLine(
        framed, (left, row - 5), (left + 30, row - 5), _TEXT_COLOUR, 2, cv2.LINE_AA, 0, 0.3
    )
    left = _write(framed, "ahead", (left + 38, row), 0.5) + 24
    if gap:
        _dashed(framed, np.array([left, row - 5.0]), np.array([left + 36, row - 5.0]))
        left = _write(framed, "frames lost", (left + 44, row), 0.5) + 24
    if limit is None:
        return
    left = _write(framed, "sigma  0", (left, row), 0.5) + 8
    bar = _colour_bar(np.linspace(0, 255, _BAR_PIXELS).astype(np.uint8))
    right = min(left + _BAR_PIXELS, framed.shape[1])
    framed[row - _BAR_HEIGHT + 2 : row + 2, left:right] = bar[None, : right - left]
    text = f"{1000.0 * limit:.3g} mm" if unit == "m" and limit < 1.0 else f"{limit:.3g} {unit}"
    _write(framed, text, (left + _BAR_PIXELS + 8, row), 0.5)


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


def _write(canvas: UInt8Array, text: str, position: tuple[int, int], size: float = 0.6) -> int:
    """Write dark on a light halo, readable on any floor; return the column where it ends."""
    halo, font = (_BACKGROUND_GRAY,) * 3, cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(canvas, text, position, font, size, halo, 4, cv2.LINE_AA)
    cv2.putText(canvas, text, position, font, size, _TEXT_COLOUR, 1, cv2.LINE_AA)
    return position[0] + int(cv2.getTextSize(text, font, size, 1)[0][0])


def _rounded(pixel: Float64Array) -> tuple[int, int]:
    return round(float(pixel[0])), round(float(pixel[1]))
