"""Correlation search: every rotation and translation of one view over another, scored.

Masked normalised cross-correlation by fast Fourier transforms (Padfield, IEEE Transactions on Image
Processing 21, 2012), a rotation at a time, on pictures with normalised local mean and contrast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from scipy import fft

from slamcli.core.arrays import BoolArray, Complex64Array, Float32Array, Float64Array, Int64Array
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import PyramidLevel
from slamcli.stages.dense.warping import warp_onto

# Rotations between two tries: the refinement converges from half a step
# [guarded by benchmarks/robustness.py: course].
_STEP_RADIANS = math.radians(4.0)
# An overlap with next to no contrast correlates by chance: this share of the whole picture's
# contrast is added to each overlap's [guarded by benchmarks/robustness.py: bare].
_SEARCH_CONTRAST_PRIOR = 0.1
_CONTRAST_PRIOR = 0.02
_HIGHEST_CORRELATION = 0.999
_MIN_PIXELS = 64.0
# Where no pixels are shared, the transforms leave rounding errors.
_NO_PIXELS = np.float32(1e-3)
# Most cameras' views have one mask.
_CACHED_MASKS = 4
# Peaks nearer than this to a higher one, in pixels and rotation steps, belong to it.
_PEAK_PIXELS = 4
_PEAK_STEPS = 2


@dataclass(frozen=True, slots=True)
class SearchWindow:
    """The motions that are searched.

    Attributes
    ----------
    centre : Pose2
        The middle of the motions ``a_from_b`` that are tried.
    angle_radians : float
        Headings tried to either side.
    radius_metres : float
        Translations tried in every direction, of the middle of what b saw; inf: all.
    max_displacement_metres : float
        The farthest that the robot may have moved from a to b; inf: any distance.
    """

    centre: Pose2 = field(default_factory=Pose2)
    angle_radians: float = math.radians(40.0)
    radius_metres: float = math.inf
    max_displacement_metres: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A motion with the evidence of the pixels for it.

    Attributes
    ----------
    a_from_b : Pose2
    correlation : float
        Of the overlap, in [-1, 1].
    overlap : float
        Share of the smaller view that both see.
    evidence : float
        Log-likelihood ratio: minus the logarithm of the share of variance that the motion leaves
        unexplained, times the overlap's pixels.
    """

    a_from_b: Pose2
    correlation: float
    overlap: float
    evidence: float


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """The result of a correlation search.

    Attributes
    ----------
    candidates : tuple of Candidate
        Peaks of the evidence, highest first.
    surface : (h, w) float32
        The best correlation over all headings, by translation: right along x, up along y.
    metres_per_pixel : float
        Of the surface, whose middle is the window's centre.
    """

    candidates: tuple[Candidate, ...]
    surface: Float32Array
    metres_per_pixel: float


def search(
    a: PyramidLevel, b: PyramidLevel, window: SearchWindow, *, min_overlap: float, count: int = 6
) -> Search:
    """Return the motions that align view b with view a best.

    Parameters
    ----------
    a, b : PyramidLevel
        The coarsest levels of two views of one grid.
    window : SearchWindow
    min_overlap : float
        Least share of the smaller view that both must see.
    count : int
        Most candidates.
    """
    values_a, weight_a = a.normalised, a.weight
    values_b, weight_b = b.normalised, b.weight
    seen = float(min(cv2.countNonZero(a.inside), cv2.countNonZero(b.inside)))
    least = max(min_overlap * seen, _MIN_PIXELS)
    middle = _middle_of(weight_b)
    shape = _shape_of_shifts(a, b, window, middle, least)
    first = _transforms(values_a, weight_a, shape)
    energy = a.energy, b.energy
    allowed = _allowed(a, window, middle, shape)
    steps = math.ceil(window.angle_radians / _STEP_RADIANS)
    rotations, correlations, shared = [], [], []
    for step in range(-steps, steps + 1):
        turn = window.centre.theta + step * _STEP_RADIANS
        rotation = np.asarray(cv2.getRotationMatrix2D(middle, math.degrees(turn), 1.0), np.float64)
        size = (values_b.shape[1], values_b.shape[0])
        turned = np.asarray(cv2.warpAffine(values_b, rotation, size), np.float32)
        weight = np.asarray(cv2.warpAffine(weight_b, rotation, size), np.float32)
        correlation, pixels = _correlate(first, _transforms(turned, weight, shape), energy, shape)
        correlation[(pixels < least) | ~allowed | _too_far(a, rotation, window, shape)] = 0.0
        rotations.append(rotation)
        correlations.append(correlation)
        shared.append(pixels)
    stack, pixels = np.stack(correlations), np.stack(shared)
    found = []
    for angle, row, column in _peaks(_evidence(stack, pixels), count):
        pose = _pose(a, rotations[angle], row, column, shape)
        value, area = float(stack[angle, row, column]), float(pixels[angle, row, column])
        found.append(Candidate(pose, value, area / seen, float(_evidence(value, area))))
    surface = np.fft.fftshift(stack.max(axis=0))
    return Search(tuple(found), np.asarray(surface, np.float32), a.metres_per_pixel)


def autocorrelation(
    level: PyramidLevel, min_overlap: float, rows_up: int
) -> tuple[Float32Array, Float32Array]:
    """Return a view's correlation with itself, shifted, and the share of it that overlaps.

    Opposite shifts correlate alike: two pictures (rows, columns) of those down, from `rows_up` up
    on; no shift is in their middle column. Of a convex view, all shifts are in them that leave an
    overlap of the share `min_overlap`: no larger than of its height and width.
    """
    sides = level.normalised.shape
    rows, columns = (math.ceil((1.0 - min_overlap) * side) for side in sides)
    shape = (
        fft.next_fast_len(sides[0] + rows, real=True),
        fft.next_fast_len(sides[1] + columns, real=True),
    )
    weighted = level.normalised * level.weight
    values = fft.rfft2(weighted, shape)
    seen, pixels = _own_shifts(level.inside.tobytes(), sides, shape)
    product = _sums_of_products(values, values, shape)
    norm = _sums_of_products(fft.rfft2(weighted * level.normalised, shape), seen, shape)
    down, right = np.arange(-rows_up, rows + 1), np.arange(-columns, columns + 1)
    opposite = norm[-down][:, -right]
    product, pixels, norm = (sums[down][:, right] for sums in (product, pixels, norm))
    correlation = _normalised(product, pixels, (norm, opposite), (level.energy, level.energy))
    whole = max(float(cv2.countNonZero(level.inside)), 1.0)
    return correlation, np.asarray(pixels / np.float32(whole))


@lru_cache(maxsize=_CACHED_MASKS)
def _own_shifts(
    inside: bytes, sides: tuple[int, int], shape: tuple[int, int]
) -> tuple[Complex64Array, Float32Array]:
    """Return the spectrum of a level's mask, and the pixels that it shares with itself, shifted.

    The same for all frames of a camera.
    """
    weight = (np.frombuffer(inside, np.uint8).reshape(sides) == 255).astype(np.float32)
    seen = fft.rfft2(weight, shape)
    return seen, _sums_of_products(seen, seen, shape)


def evidence(
    a: PyramidLevel, b: PyramidLevel, a_from_b: Pose2, view_a_from_view_b: Float64Array
) -> Candidate:
    """Return one motion with the evidence of two views' pixels for it.

    Parameters
    ----------
    a, b : PyramidLevel
    a_from_b : Pose2
    view_a_from_view_b : (3, 3) float64
        Metres to metres: that motion, or a `PhotometricFit`'s.
    """
    moved, inside = warp_onto(a, b, view_a_from_view_b, b.normalised, b.inside)
    weight = cv2.multiply(a.weight, inside.view(np.uint8), dtype=cv2.CV_32F)
    pixels = _total(weight)
    seen = float(min(cv2.countNonZero(a.inside), cv2.countNonZero(b.inside)))
    if pixels < _MIN_PIXELS:
        return Candidate(a_from_b, 0.0, pixels / max(seen, 1.0), 0.0)
    weighted_a, weighted_b = cv2.multiply(weight, a.normalised), cv2.multiply(weight, moved)
    product = _total(cv2.multiply(weighted_a, moved))
    prior = _CONTRAST_PRIOR * pixels
    norm_a = _total(cv2.multiply(weighted_a, a.normalised)) + prior * a.energy
    norm_b = _total(cv2.multiply(weighted_b, moved)) + prior * b.energy
    value = product / math.sqrt(norm_a * norm_b) if norm_a * norm_b > 0 else 0.0
    return Candidate(a_from_b, value, pixels / seen, float(_evidence(value, pixels)))


def _total(values: cv2.typing.MatLike) -> float:
    """Return the sum, in double precision: numpy's over floats is slower and less exact."""
    return float(cv2.sumElems(values)[0])


def _middle_of(weight: Float32Array) -> tuple[float, float]:
    """Return the (column, row) in the middle of what was seen: turned about it, it stays inside."""
    rows, columns = np.nonzero(weight)
    if len(rows) == 0:
        return 0.0, 0.0
    return float(columns.min() + columns.max()) / 2, float(rows.min() + rows.max()) / 2


def _transforms(
    values: Float32Array, weight: Float32Array, shape: tuple[int, int]
) -> tuple[Complex64Array, Complex64Array, Complex64Array]:
    """Return the spectra of a picture, of its square, and of its mask."""
    weighted = values * weight
    return (
        fft.rfft2(weighted, shape),
        fft.rfft2(weighted * values, shape),
        fft.rfft2(weight, shape),
    )


def _correlate(
    first: tuple[Complex64Array, ...],
    second: tuple[Complex64Array, ...],
    energy: tuple[float, float],
    shape: tuple[int, int],
) -> tuple[Float32Array, Float32Array]:
    """Return the correlation and the shared pixels at every translation of the second picture."""
    values, squares, seen = second
    product = _sums_of_products(first[0], values, shape)
    pixels = np.maximum(_sums_of_products(first[2], seen, shape), _NO_PIXELS)
    norm_a = _sums_of_products(first[1], seen, shape)
    norm_b = _sums_of_products(first[2], squares, shape)
    return _normalised(product, pixels, (norm_a, norm_b), energy), pixels


def _sums_of_products(
    first: Complex64Array, second: Complex64Array, shape: tuple[int, int]
) -> Float32Array:
    """Return the sum of products of two pictures, by their spectra, at every shift of the second.

    To the right along the columns and down along the rows, cyclic.
    """
    return np.asarray(fft.irfft2(first * np.conj(second), shape), np.float32)


def _normalised(
    product: Float32Array,
    pixels: Float32Array,
    norms: tuple[Float32Array, Float32Array],
    energy: tuple[float, float],
) -> Float32Array:
    """Return sums of products as correlations, by both pictures' sums of squares there."""
    prior = [np.float32(_SEARCH_CONTRAST_PRIOR * mean) * pixels for mean in energy]
    norm_a, norm_b = (np.maximum(norm, 0) for norm in norms)
    norm_a += prior[0]
    norm_b += prior[1]
    correlation = product / np.sqrt(np.maximum(norm_a * norm_b, np.float32(1e-12)))
    return np.asarray(correlation, np.float32)


def _evidence(correlation: float | Float32Array, pixels: float | Float32Array) -> Float64Array:
    """Return ``-n log(1 - r^2)``: twice the log likelihood ratio to unrelated pictures."""
    bounded = np.clip(correlation, 0.0, _HIGHEST_CORRELATION)
    return np.asarray(-np.log1p(-(bounded**2)) * pixels)


def _shape_of_shifts(
    a: PyramidLevel,
    b: PyramidLevel,
    window: SearchWindow,
    middle: tuple[float, float],
    min_pixels: float,
) -> tuple[int, int]:
    """Return the rows and columns of transforms in which no shift of interest wraps around.

    Of pictures of n pixels, shifts of up to m need n + m. Of interest are those within the window
    that leave an overlap of `min_pixels`.
    """
    height, width = (
        max(*sides) for sides in zip(a.normalised.shape, b.normalised.shape, strict=True)
    )
    # One more: where shifts wrap around, the overlaps of two are then together too small.
    rows = max(math.ceil(height - min_pixels / width), 0) + 1
    columns = max(math.ceil(width - min_pixels / height), 0) + 1
    if not math.isinf(window.radius_metres):
        row, column = _middle_of_window(a, window, middle)
        radius = window.radius_metres / a.metres_per_pixel
        rows = min(rows, math.ceil(abs(row) + radius))
        columns = min(columns, math.ceil(abs(column) + radius))
    return (
        fft.next_fast_len(height + rows, real=True),
        fft.next_fast_len(width + columns, real=True),
    )


def _middle_of_window(
    a: PyramidLevel, window: SearchWindow, middle: tuple[float, float]
) -> tuple[float, float]:
    """Return the rows and columns by which a window's centre shifts the middle of b's view."""
    seen = apply_homography(invert(a.pixel_from_metres), np.array([middle]))
    there = apply_homography(a.pixel_from_metres, window.centre.apply(seen))[0]
    return float(there[1] - middle[1]), float(there[0] - middle[0])


def _allowed(
    a: PyramidLevel, window: SearchWindow, middle: tuple[float, float], shape: tuple[int, int]
) -> BoolArray:
    """Return which translations of the middle of b's view lie within the window."""
    if math.isinf(window.radius_metres):
        return np.ones(shape, np.bool_)
    row, column = _middle_of_window(a, window, middle)
    rows = _signed(np.arange(shape[0]), shape[0])[:, None] - row
    columns = _signed(np.arange(shape[1]), shape[1])[None, :] - column
    inside: BoolArray = np.hypot(rows, columns) <= window.radius_metres / a.metres_per_pixel
    return inside


def _too_far(
    a: PyramidLevel, rotation: Float64Array, window: SearchWindow, shape: tuple[int, int]
) -> BoolArray:
    """Return which translations of a turned picture exceed the robot's largest displacement."""
    if math.isinf(window.max_displacement_metres):
        return np.zeros(shape, np.bool_)
    robot = a.pixel_from_metres[:2, 2]
    column, row = rotation @ (*robot, 1.0) - robot
    rows = _signed(np.arange(shape[0]), shape[0])[:, None] + row
    columns = _signed(np.arange(shape[1]), shape[1])[None, :] + column
    beyond: BoolArray = (
        np.hypot(rows, columns) > window.max_displacement_metres / a.metres_per_pixel
    )
    return beyond


def _signed(shift: Int64Array, length: int) -> Int64Array:
    """Return cyclic shifts as signed ones."""
    return np.where(shift < length - length // 2, shift, shift - length)


def _peaks(evidence_of: Float64Array, count: int) -> list[tuple[int, int, int]]:
    """Return (angle, row, column) of the highest values that are not each other's neighbours."""
    remaining = evidence_of.copy()
    angles, height, width = remaining.shape
    around = np.arange(-_PEAK_PIXELS, _PEAK_PIXELS + 1)
    peaks = []
    for _ in range(count):
        angle, row, column = (
            int(i) for i in np.unravel_index(int(remaining.argmax()), remaining.shape)
        )
        if not remaining[angle, row, column] > 0:
            break
        peaks.append((angle, row, column))
        near = np.arange(max(0, angle - _PEAK_STEPS), min(angles, angle + _PEAK_STEPS + 1))
        remaining[np.ix_(near, (row + around) % height, (column + around) % width)] = 0.0
    return peaks


def _pose(
    a: PyramidLevel,
    rotation: Float64Array,
    row: int,
    column: int,
    shape: tuple[int, int],
) -> Pose2:
    """Return ``a_from_b`` of a picture turned by `rotation` and shifted."""
    shift = np.eye(3)
    shift[0, 2] = float(_signed(np.array(column), shape[1]))
    shift[1, 2] = float(_signed(np.array(row), shape[0]))
    a_pixel_from_b_pixel = shift @ np.vstack([rotation, [0.0, 0.0, 1.0]])
    return Pose2.from_matrix(
        invert(a.pixel_from_metres) @ a_pixel_from_b_pixel @ a.pixel_from_metres
    )
