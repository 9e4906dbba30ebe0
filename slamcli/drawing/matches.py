"""Drawing of matches: two images side by side, and one overlaid on the other."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, UInt8Array
from slamcli.core.geometry import apply_homography
from slamcli.core.names import readable

_INLIER_COLOUR = (60, 200, 40)
_OUTLIER_COLOUR = (70, 70, 230)
_OUTLINE_COLOUR = (0, 200, 255)
_BACKGROUND_GRAY = 245
_TEXT_COLOUR = (30, 30, 30)
_LINE_HEIGHT = 24
_GAP = 8
_MAX_COLUMNS = 2400
_MIN_PANEL_HEIGHT = 360
# More lines than this hide the images; the header has the number of all.
_MAX_LINES = 100
_SHIFT = 4


def draw_matches(
    first: UInt8Array,
    second: UInt8Array,
    points_first: Float64Array,
    points_second: Float64Array,
    inliers: BoolArray,
    second_from_first: Float64Array | None,
    header: Sequence[str],
) -> UInt8Array:
    """Return the first image, the second, and the second overlaid with the first.

    Parameters
    ----------
    first, second : (h, w, 3) uint8 BGR
    points_first, points_second : (M, 2) float64
        Pixels of each image: the matches.
    inliers : (M,) bool
        Thick green lines; the others are thin and red.
    second_from_first : (3, 3) float64 or None
        Pixel to pixel; None leaves out the third panel.
    header : lines of text
    """
    panels = [first, second]
    if second_from_first is not None:
        panels.append(_overlaid(first, second, second_from_first))
    scale = _scale(panels)
    resized = [_resized(panel, scale) for panel in panels]
    height = max(panel.shape[0] for panel in resized)
    width = sum(panel.shape[1] for panel in resized) + _GAP * (len(resized) - 1)
    canvas = np.full((height, width, 3), _BACKGROUND_GRAY, np.uint8)
    left, offsets = 0, []
    for panel in resized:
        canvas[: panel.shape[0], left : left + panel.shape[1]] = panel
        offsets.append(left)
        left += panel.shape[1] + _GAP
    starts = points_first * scale
    ends = points_second * scale + (offsets[1], 0)
    for chosen, colour, thickness in (
        (~inliers, _OUTLIER_COLOUR, 1),
        (inliers, _INLIER_COLOUR, 2),
    ):
        _draw_lines(canvas, starts[chosen], ends[chosen], colour, thickness)
    legend = "green: inliers; red: other matches; some of each"
    if second_from_first is not None:
        legend += "; yellow: outline of the first picture on the second"
    return np.vstack([_text([*header, legend], width), canvas])


def _overlaid(first: UInt8Array, second: UInt8Array, second_from_first: Float64Array) -> UInt8Array:
    """Return the second image, half of it the first warped, with the first's outline."""
    size = (second.shape[1], second.shape[0])
    warped = cv2.warpPerspective(first, second_from_first, size, flags=cv2.INTER_AREA)
    everywhere = np.full(first.shape[:2], 255, np.uint8)
    covered = cv2.warpPerspective(everywhere, second_from_first, size) == 255
    blend = cv2.addWeighted(second, 0.5, warped, 0.5, 0.0)
    canvas = np.where(covered[..., None], blend, second)
    right, bottom = first.shape[1] - 1, first.shape[0] - 1
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], np.float64)
    depth = corners @ second_from_first[2, :2] + second_from_first[2, 2]
    if np.all(depth > 0):
        outline = apply_homography(second_from_first, corners)
        # Far beyond the image the drawing's integers would overflow.
        outline = np.clip(outline, -20_000, 20_000)
        fixed = np.round(outline * 2**_SHIFT).astype(np.int32)
        cv2.polylines(
            canvas,
            [fixed],
            isClosed=True,
            color=_OUTLINE_COLOUR,
            thickness=max(2, round(max(size) / 400)),
            lineType=cv2.LINE_AA,
            shift=_SHIFT,
        )
    return canvas


def _scale(panels: Sequence[UInt8Array]) -> float:
    columns = sum(panel.shape[1] for panel in panels) + _GAP * (len(panels) - 1)
    rows = max(panel.shape[0] for panel in panels)
    return float(min(max(1.0, _MIN_PANEL_HEIGHT / rows), _MAX_COLUMNS / columns))


def _resized(image: UInt8Array, scale: float) -> UInt8Array:
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)


def _draw_lines(
    canvas: UInt8Array,
    starts: Float64Array,
    ends: Float64Array,
    colour: tuple[int, int, int],
    thickness: int,
) -> None:
    step = max(1, -(-len(starts) // _MAX_LINES))
    for start, end in zip(starts[::step], ends[::step], strict=True):
        a, b = (tuple(int(v) for v in np.round(pixel)) for pixel in (start, end))
        cv2.line(canvas, a, b, colour, thickness, cv2.LINE_AA)
        for pixel in (a, b):
            cv2.circle(canvas, pixel, 3, colour, thickness, cv2.LINE_AA)


def _text(lines: Sequence[str], width: int) -> UInt8Array:
    header = np.full((_LINE_HEIGHT * len(lines) + 8, width, 3), _BACKGROUND_GRAY, np.uint8)
    for number, line in enumerate(map(readable, lines)):  # OpenCV's crash on any other
        (columns, _), _ = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)
        size = 0.6 * min(1.0, (width - 16) / max(1, columns))
        position = (8, _LINE_HEIGHT * (number + 1) - 4)
        cv2.putText(
            header, line, position, cv2.FONT_HERSHEY_SIMPLEX, size, _TEXT_COLOUR, 1, cv2.LINE_AA
        )
    return header
