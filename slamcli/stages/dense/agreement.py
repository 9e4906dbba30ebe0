"""Photometric agreement of two views under a motion: correlation, overlap, and patch by patch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import PyramidLevel, SampledLevel
from slamcli.stages.dense.warping import warp_onto

_MIN_SHARED_PIXELS = 200
_OVERLAP_STEP = 8
# Patches are informative when they vary by more than the camera's noise does in a view: that has
# less than half of the frame's own variance, as pixels are interpolated, and a patch with as much
# noise as pattern still agrees with itself [guarded by benchmarks/robustness.py: noise].
_PATCH_PIXELS = 16
_MIN_INFORMATIVE_GRAY = 3.0
_INFORMATIVE_NOISE_SHARE = 0.95
_MIN_PATCHES = 12
# A patch agrees from this correlation on [guarded by benchmarks/robustness.py: legs].
_PATCH_CORRELATION = 0.5
# Two motions are compared at a quarter of the resolution, where noise and the blur of farther views
# differ little: a patch prefers a motion under which it correlates better by the first margin, and
# at least by the second number, as what obstacles hide agrees with either only by chance
# [guarded by benchmarks/robustness.py: tiles, legs on tiles].
_PREFERENCE_PATCH_PIXELS = 12
_HALVED_NOISE = 0.5
_MIN_PREFERENCE_MARGIN = 0.05
_MIN_PREFERRED_CORRELATION = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """Photometric agreement of two overlapping views under a motion.

    Attributes
    ----------
    correlation : float
        Zero-mean normalised cross-correlation of the overlap, in [-1, 1].
    overlap : float
        Share of the smaller view's floor that both see.
    confirmed : float
        Share of the overlap's informative patches that agree each by itself, in [0, 1]: obstacles
        on a floor that is seen well leave the others in agreement. nan where too few patches are
        informative.
    """

    correlation: float
    overlap: float
    confirmed: float


def overlap(a: PyramidLevel, b: PyramidLevel | SampledLevel, a_from_b: Pose2) -> float:
    """Return the share of b's floor that a sees too, estimated from every eighth pixel."""
    rows, columns = np.nonzero(b.mask[::_OVERLAP_STEP, ::_OVERLAP_STEP])
    pixels_b = _OVERLAP_STEP * np.column_stack([columns, rows])
    a_from_pixel_b = a_from_b.matrix @ invert(b.pixel_from_metres)
    pixels_a = apply_homography(a.pixel_from_metres @ a_from_pixel_b, pixels_b)
    column, row = np.round(pixels_a).astype(np.int64).T
    height, width = a.mask.shape
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    shared = np.count_nonzero(a.mask[row[inside], column[inside]])
    return shared / max(1, len(rows))


def agreement(a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array) -> Agreement:
    """Correlate the overlap of two views, at one level of their pyramids.

    Parameters
    ----------
    a, b : PyramidLevel
    view_a_from_view_b : (3, 3) float64
        Metres to metres: a motion, or a `PhotometricFit`'s.
    """
    moved, both = _warped_onto(a, b, view_a_from_view_b)
    smaller = int(min(np.count_nonzero(a.mask == 255), np.count_nonzero(b.mask == 255)))
    shared = int(np.count_nonzero(both))
    if shared < _MIN_SHARED_PIXELS:
        return Agreement(math.nan, shared / max(1, smaller), math.nan)
    image_a = a.image.astype(np.float32)
    correlation = _correlation(image_a, moved, both)
    patches, informative = _patch_correlations(
        image_a, moved, both, _PATCH_PIXELS, _min_deviation(a, b)
    )
    confirmed = math.nan
    if np.count_nonzero(informative) >= _MIN_PATCHES:
        agree = patches > _PATCH_CORRELATION
        confirmed = float(np.mean(agree[informative]))
    return Agreement(correlation, shared / smaller, confirmed)


def _correlation(first: Float32Array, second: Float32Array, both: BoolArray) -> float:
    """Return the correlation of two pictures inside a mask; 0 where either is uniform."""
    count, mask = np.count_nonzero(both), both.view(np.uint8)
    seen_a, seen_b = (cv2.multiply(one, mask, dtype=cv2.CV_32F) for one in (first, second))
    # OpenCV adds up in double precision. The sum of products is half of what the sums of squares
    # exceed that of the squared difference by.
    total_a, total_b = cv2.sumElems(seen_a)[0], cv2.sumElems(seen_b)[0]
    square_a, square_b = cv2.norm(seen_a, cv2.NORM_L2SQR), cv2.norm(seen_b, cv2.NORM_L2SQR)
    product = (square_a + square_b - cv2.norm(seen_a, seen_b, cv2.NORM_L2SQR)) / 2.0
    energy_a = square_a - total_a**2 / count
    energy_b = square_b - total_b**2 / count
    if energy_a <= 0.0 or energy_b <= 0.0:
        return 0.0
    return float((product - total_a * total_b / count) / math.sqrt(energy_a * energy_b))


def patch_votes(
    a: PyramidLevel,
    b: PyramidLevel,
    view_a_from_view_b: Float64Array,
    rival: Float64Array,
) -> tuple[float, float]:
    """Return the shares of the informative patches that prefer a motion, and that prefer its rival.

    Where a floor repeats, both motions explain nearly all of it; scratches, stains and wear
    distinguish them, by a little in each of many patches. A patch that agrees under the first alone
    may show an obstacle and does not count for it. nan where too few patches are informative.

    Parameters
    ----------
    a, b : PyramidLevel
        The second of each pyramid.
    view_a_from_view_b, rival : (3, 3) float64
    """
    side, least = _PREFERENCE_PATCH_PIXELS, _min_deviation(a, b, _HALVED_NOISE)
    warped = _warped_onto(a, b, view_a_from_view_b)
    image_a = a.image.astype(np.float32)
    first, informative = _patch_correlations(image_a, *warped, side, least)
    second, informative_too = _patch_correlations(image_a, *_warped_onto(a, b, rival), side, least)
    both = informative & informative_too
    count = np.count_nonzero(both)
    if count < _MIN_PATCHES:
        return math.nan, math.nan
    pro = (
        both
        & (first > np.maximum(second + _MIN_PREFERENCE_MARGIN, _MIN_PREFERRED_CORRELATION))
        & (second > _PATCH_CORRELATION)
    )
    contra = both & (
        second > np.maximum(first + _MIN_PREFERENCE_MARGIN, _MIN_PREFERRED_CORRELATION)
    )
    return float(np.count_nonzero(pro) / count), float(np.count_nonzero(contra) / count)


def keep_agreeing_points(
    levels_a: Sequence[PyramidLevel], b: PyramidLevel, view_a_from_view_b: Float64Array
) -> tuple[PyramidLevel, ...]:
    """Return levels of view a with those points alone that lie in patches which agree with b.

    That leaves out the points of obstacles.

    Parameters
    ----------
    levels_a : sequence of PyramidLevel
        From fine to coarse.
    b : PyramidLevel
        The finest of the other view.
    view_a_from_view_b : (3, 3) float64
    """
    finest = levels_a[0]
    patches, informative = _patch_correlations(
        finest.image.astype(np.float32),
        *_warped_onto(finest, b, view_a_from_view_b),
        _PATCH_PIXELS,
        _min_deviation(finest, b),
    )
    rows, columns = (side // _PATCH_PIXELS for side in finest.image.shape)
    agree = (informative & (patches > _PATCH_CORRELATION)).reshape(rows, columns)
    kept = []
    for level in levels_a:
        pixels = apply_homography(finest.pixel_from_metres, level.points)
        column, row = np.floor_divide(np.rint(pixels), _PATCH_PIXELS).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        inside[inside] = agree[row[inside], column[inside]]
        kept.append(level.part(inside))
    return tuple(kept)


def _warped_onto(
    a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array
) -> tuple[Float32Array, BoolArray]:
    """Return b's picture warped onto a's pixels, and where both see the floor."""
    moved, seen = warp_onto(a, b, view_a_from_view_b, b.image, b.mask)
    return moved, seen & (a.mask == 255)


def _min_deviation(a: PyramidLevel, b: PyramidLevel, noise_share: float = 1.0) -> float:
    """Return the least standard deviation of an informative patch, gray levels.

    `noise_share` is what halving leaves of the frame's noise.
    """
    noise_gray = noise_share * max(a.frame_noise_gray, b.frame_noise_gray)
    return max(_MIN_INFORMATIVE_GRAY, _INFORMATIVE_NOISE_SHARE * noise_gray)


def _patch_correlations(
    image_a: Float32Array,
    image_b: Float32Array,
    both: BoolArray,
    side: int,
    min_deviation_gray: float,
) -> tuple[Float32Array, BoolArray]:
    """Return each patch's own correlation, and whether it is whole and informative."""
    rows, columns = (length // side for length in both.shape)
    first, second = (
        picture[: rows * side, : columns * side]
        .reshape(rows, side, columns, side)
        .transpose(0, 2, 1, 3)
        for picture in (image_a, image_b)
    )
    # One axis after the other, rows first: several times as fast as both at once.
    whole = both[: rows * side, : columns * side].reshape(rows, side, columns * side)
    whole = np.logical_and.reduce(whole, axis=1).reshape(rows, columns, side).all(axis=2)
    correlation = np.zeros((rows, columns), np.float32)
    informative = np.zeros((rows, columns), np.bool_)
    # Sums as products with a vector: numpy's own along an axis are several times as slow.
    mean = np.full(side**2, 1.0 / side**2, np.float32)
    patch_a, patch_b = first[whole].reshape(-1, side**2), second[whole].reshape(-1, side**2)
    patch_a -= (patch_a @ mean)[:, None]
    patch_b -= (patch_b @ mean)[:, None]
    energy_a, energy_b, product = (
        np.einsum("ij,ij->i", one, other) * mean[0]
        for one, other in ((patch_a, patch_a), (patch_b, patch_b), (patch_a, patch_b))
    )
    informative[whole] = np.maximum(energy_a, energy_b) > min_deviation_gray**2
    norm = np.sqrt(np.maximum(energy_a * energy_b, np.float32(1e-6)))
    correlation[whole] = product / norm
    return correlation.ravel(), informative.ravel()
