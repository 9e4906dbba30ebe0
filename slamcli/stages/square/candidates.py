"""Square candidates: quadrilaterals from the outlines of regions at many thresholds.

A region's outline is cut into straight pieces, and every four of them that close to a convex
quadrilateral are a candidate: so a painted line that touches the square, which adds corners to the
outline, leaves the four that count among the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import combinations

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, Int32Array, IntpArray, UInt8Array

# Smaller than this share of the picture a square determines little of the camera
# [guarded by tests/stages/test_square.py].
_MIN_AREA_SHARE = 0.0008
_MIN_AREA_PIXELS = 150.0
# Gray levels at which the picture is cut, and openings that shed thin lines at each.
_THRESHOLD_LEVELS = 14
_OPENINGS_PIXELS = (0, 7, 15)
# How far an outline may leave its straight pieces, as shares of its size.
_TOLERANCES = (0.02, 0.04, 0.08)
# Four of ten pieces are 210 candidates; an outline of more vertices is no painted shape.
_MAX_PIECES = 10
_MAX_VERTICES = 40
_FEW_SAMPLES_PER_SIDE = 6
_SAMPLES_PER_SIDE = 24
# Share of the samples along the sides that must show the step: saves refining what `search` rejects
# too (no test depends on its value).
_MIN_SUPPORT = 0.35
# Two quadrilaterals are one when no corner differs by more than this share of their size.
_SAME_SHARE = 0.06
_SAME_AREA_SHARE = 0.03
_SAME_BOX_PIXELS = 3


def find_candidates(image: UInt8Array, max_count: int) -> tuple[Float64Array, Float64Array]:
    """Return the quadrilaterals best supported by edges.

    Parameters
    ----------
    image : (H, W) uint8
        About a thousand pixels wide at most: the thresholds and openings are made for that.
    max_count : int

    Returns
    -------
    quads : (N, 4, 2) float64
        Corners in pixels, clockwise in the picture, best first; N <= max_count.
    supports : (N,) float64
        In [0, 1].
    """
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.2), dtype=np.uint8)
    height, width = image.shape
    min_area = max(_MIN_AREA_PIXELS, _MIN_AREA_SHARE * width * height)
    outlines: dict[tuple[int, ...], Int32Array] = {}
    for binary in _binaries(smooth):
        for outline in _outlines(binary, min_area):
            outlines.setdefault(_rough_shape(outline), outline)
    found = [
        quads for outline in outlines.values() for quads in _quads_of_outline(outline, min_area)
    ]
    if not found:
        return np.empty((0, 4, 2)), np.empty(0)
    quads = np.concatenate(found)
    inside = np.all((quads > 0) & (quads < (width - 1, height - 1)), axis=(1, 2))
    quads = quads[inside]
    _, first = np.unique(np.rint(quads / 2.0).reshape(-1, 8), axis=0, return_index=True)
    quads = quads[np.sort(first)]
    # Few samples of each, then more of those that pass: most are no square at all.
    quads = quads[edge_support(smooth, quads, _FEW_SAMPLES_PER_SIDE) >= _MIN_SUPPORT]
    supports = edge_support(smooth, quads, _SAMPLES_PER_SIDE)
    return _keep_distinct(quads, supports, max_count)


def edge_support(smooth: UInt8Array, quads: Float64Array, samples: int) -> Float64Array:
    """Return (N,) how well a step of one sign, light or dark inside, runs along all four sides.

    Each side's support is the share of its samples that show the step; the weakest side and the
    mean of all count alike.
    """
    if len(quads) == 0:
        return np.empty(0)
    ends = np.roll(quads, -1, axis=1)
    along = ends - quads
    length = np.linalg.norm(along, axis=2)
    outward = np.stack([along[..., 1], -along[..., 0]], axis=-1) / length[..., None]
    steps = np.linspace(0.06, 0.94, samples)
    points = quads[:, :, None] + along[:, :, None] * steps[None, None, :, None]
    # Far enough from the edge that neither blur nor a loosely placed candidate hides the step.
    size = np.sqrt(quad_area(quads))
    reach = np.clip(0.03 * size, 2.5, 6.0)[:, None, None, None]
    shift = outward[:, :, None] * reach
    step = _look_up(smooth, points - shift) - _look_up(smooth, points + shift)
    typical = np.median(step, axis=(1, 2))
    needed = np.maximum(0.4 * np.abs(typical), 6.0)[:, None, None]
    shown = step * np.sign(typical)[:, None, None] >= needed
    side_support = shown.mean(axis=2)
    support: Float64Array = 0.5 * (side_support.min(axis=1) + side_support.mean(axis=1))
    return support


def quad_area(quads: Float64Array) -> Float64Array:
    """Return (...,) square pixels enclosed by (..., 4, 2) corners."""
    first, second = quads[..., 2, :] - quads[..., 0, :], quads[..., 3, :] - quads[..., 1, :]
    area: Float64Array = 0.5 * np.abs(
        first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
    )
    return area


def inner_radius(quad: Float64Array) -> float:
    """Return about the radius, pixels, of the largest circle in a quadrilateral."""
    perimeter = float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).sum())
    return 2.0 * float(quad_area(quad)) / perimeter


def same_quad(quad: Float64Array, others: Float64Array) -> BoolArray:
    """Return (N,) whether each of (N, 4, 2) quadrilaterals is `quad` but for small differences."""
    size = float(np.sqrt(quad_area(quad)))
    same = np.zeros(len(others), dtype=bool)
    for turn in range(4):
        differences = np.linalg.norm(others - np.roll(quad, turn, axis=0), axis=2)
        same |= differences.max(axis=1) < max(_SAME_SHARE * size, 3.0)
    return same


def _binaries(smooth: UInt8Array) -> Iterator[UInt8Array]:
    """Yield the picture cut at many levels, each opened to shed thin lines, light and dark."""
    low, high = np.percentile(smooth, (1, 99))
    levels = np.linspace(low, high, _THRESHOLD_LEVELS + 2)[1:-1]
    cuts = [smooth > level for level in levels]
    for share in (0.12, 0.4):
        block = int(share * smooth.shape[1]) | 1
        mean = cv2.boxFilter(smooth, cv2.CV_32F, (block, block), borderType=cv2.BORDER_REPLICATE)
        cuts += [smooth > mean + 6.0, smooth > mean - 6.0]
    for cut in cuts:
        for binary in (cut, ~cut):
            mask = binary.astype(np.uint8)
            for opening in _OPENINGS_PIXELS:
                if opening:
                    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (opening, opening))
                    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), np.uint8)
                yield mask


def _outlines(binary: UInt8Array, min_area: float) -> list[Int32Array]:
    contours, _ = cv2.findContours(binary, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [
        np.asarray(contour[:, 0], dtype=np.int32)
        for contour in contours
        if cv2.contourArea(contour) >= min_area
    ]


def _rough_shape(outline: Int32Array) -> tuple[int, ...]:
    """Return a key that is equal for outlines of one region at neighbouring thresholds."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    log_area = round(float(np.log(cv2.contourArea(outline))) / _SAME_AREA_SHARE)
    log_length = round(float(np.log(len(outline))) / _SAME_AREA_SHARE)
    return (*(np.concatenate([low, high]) // _SAME_BOX_PIXELS).tolist(), log_area, log_length)


def _quads_of_outline(outline: Int32Array, min_area: float) -> Iterator[Float64Array]:
    """Yield (N, 4, 2) convex quadrilaterals made of four straight pieces of one outline."""
    size = float(np.sqrt(cv2.contourArea(outline)))
    for tolerance in _TOLERANCES:
        epsilon = max(1.5, tolerance * size)
        vertices = cv2.approxPolyDP(outline, epsilon, True)[:, 0]  # noqa: FBT003
        if not 4 <= len(vertices) <= _MAX_VERTICES:
            continue
        lines = _fit_pieces(outline, np.asarray(vertices, dtype=np.int32))
        quads = _close_pieces(lines)
        quads = quads[quad_area(quads) >= min_area]
        if len(quads):
            yield quads


def _fit_pieces(outline: Int32Array, vertices: Int32Array) -> Float64Array:
    """Return (n, 3) lines fitted to the outline's points along its longest straight pieces."""
    cuts = _indices_of(vertices, outline)
    counts = (np.roll(cuts, -1) - cuts) % len(outline)
    pieces = np.sort(np.argsort(-counts, kind="stable")[:_MAX_PIECES])
    # The ends are rounded by blur and opening.
    firsts = cuts[pieces] + counts[pieces] // 10
    afters = cuts[pieces] + counts[pieces] - counts[pieces] // 10 + 1
    long_enough = afters - firsts >= 3
    firsts, afters = firsts[long_enough], afters[long_enough]
    # Total least squares from running sums, over the outline twice as a piece may pass its start.
    middle = outline.mean(axis=0)
    x, y = np.tile(outline - middle, (2, 1)).T
    sums = np.cumsum(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]), axis=1)
    sums = np.pad(sums, ((0, 0), (1, 0)))
    total = sums[:, afters] - sums[:, firsts]
    mean_x, mean_y, xx, xy, yy = total[1:] / total[0]
    angle = 0.5 * np.arctan2(2.0 * (xy - mean_x * mean_y), (xx - mean_x**2) - (yy - mean_y**2))
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    heading = outline[(afters - 1) % len(outline)] - outline[firsts % len(outline)]
    backwards = np.sum(direction * heading, axis=1) < 0
    direction[backwards] *= -1.0
    centre = np.column_stack([mean_x, mean_y]) + middle
    return line_through(centre, centre + direction)


def _indices_of(vertices: Int32Array, outline: Int32Array) -> IntpArray:
    """Return the indices in the outline of some of its points."""
    codes = outline[:, 0].astype(np.int64) << 32 | outline[:, 1]
    order = np.argsort(codes, kind="stable")
    wanted = vertices[:, 0].astype(np.int64) << 32 | vertices[:, 1]
    return order[np.searchsorted(codes[order], wanted)]


def _close_pieces(lines: Float64Array) -> Float64Array:
    """Intersect every four lines, in their order around the outline; keep the convex results."""
    if len(lines) < 4:
        return np.empty((0, 4, 2))
    chosen = lines[_fours(len(lines))]
    quads = intersect(np.roll(chosen, 1, axis=1), chosen)
    quads = np.concatenate([quads, quads[:, ::-1]])
    return quads[is_convex(quads)]


@cache
def _fours(count: int) -> IntpArray:
    return np.array(list(combinations(range(count), 4)))


def line_through(first: Float64Array, second: Float64Array) -> Float64Array:
    """Return (..., 3) lines a x + b y + c = 0, (a, b) of length 1, through two points each."""
    along = second - first
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-12)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    offset = -np.sum(normal * first, axis=-1, keepdims=True)
    return np.concatenate([normal, offset], axis=-1)


def intersect(first: Float64Array, second: Float64Array) -> Float64Array:
    """Return (..., 2) points where lines meet; nan where they are parallel."""
    crossing = np.cross(first, second)
    parallel = np.abs(crossing[..., 2:]) < 1e-9
    divisor = np.where(parallel, np.nan, crossing[..., 2:])
    points: Float64Array = crossing[..., :2] / divisor
    return points


def is_convex(quads: Float64Array) -> BoolArray:
    """Return (...,) whether (..., 4, 2) corners turn right at each (clockwise in the picture)."""
    along = np.roll(quads, -1, axis=-2) - quads
    following = np.roll(along, -1, axis=-2)
    turn = along[..., 0] * following[..., 1] - along[..., 1] * following[..., 0]
    lengths = np.linalg.norm(along, axis=-1) * np.linalg.norm(following, axis=-1)
    with np.errstate(invalid="ignore"):
        convex: BoolArray = np.all(turn > 0.08 * lengths, axis=-1)
    return convex


def _look_up(image: UInt8Array, points: Float64Array) -> Float64Array:
    height, width = image.shape
    columns = np.clip(np.rint(points[..., 0]).astype(np.intp), 0, width - 1)
    rows = np.clip(np.rint(points[..., 1]).astype(np.intp), 0, height - 1)
    return image[rows, columns].astype(np.float64)


def _keep_distinct(
    quads: Float64Array, supports: Float64Array, max_count: int
) -> tuple[Float64Array, Float64Array]:
    """Keep the best of each group of near-equal quadrilaterals, large before small at a tie."""
    ranking = supports * quad_area(quads) ** 0.1
    order = np.argsort(-ranking, kind="stable")
    order = order[supports[order] >= _MIN_SUPPORT]
    kept: list[int] = []
    while len(order) and len(kept) < max_count:
        best, order = order[0], order[1:]
        kept.append(int(best))
        order = order[~same_quad(quads[best], quads[order])]
    return quads[kept], supports[kept]
