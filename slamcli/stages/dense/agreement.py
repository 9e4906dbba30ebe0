"""How well two views agree under a motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import PyramidLevel, View

_MIN_SHARED_PIXELS = 200
_OVERLAP_STEP = 16
# Patches tell something when they vary by more than a camera's noise does at half resolution: what
# the warp and the halving leave of it has a third of the frame's own variance at most, and a patch
# with half as much noise as pattern still agrees with itself.
_PATCH_PIXELS = 16
_TELLING_GRAY = 3.0
_TELLING_NOISE_SHARE = 0.7
_MIN_PATCHES = 12
_PATCH_CORRELATION = 0.5
# Two motions are compared at a quarter of the resolution, where noise and what a view farther away
# blurs differ little: by so much better must a patch agree under one motion to speak for it, and so
# well, as what legs hide agrees with neither, by chance better with one.
_PREFERENCE_PATCH_PIXELS = 12
_HALVED_NOISE = 0.5
_BETTER = 0.05
_WELL = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How two overlapping views compare under a motion.

    Attributes
    ----------
    correlation : float
        Zero-mean normalised cross-correlation of the overlap, in [-1, 1].
    overlap : float
        Share of the smaller view's floor that both see.
    confirmed : float
        Share of the overlap's telling patches that agree each by itself, in [0, 1]: where something
        stands or walks on a floor that is seen well, the others are the floor. nan where too few
        patches tell.
    """

    correlation: float
    overlap: float
    confirmed: float


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


def agreement(a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array) -> Agreement:
    """Correlate the overlap of two views, at one level of their pyramids.

    Parameters
    ----------
    a, b : PyramidLevel
    view_a_from_view_b : (3, 3) float64
        Metres to metres: a motion, or a `PhotometricFit`'s.
    """
    moved, both = _laid_over(a, b, view_a_from_view_b)
    smaller = int(min(np.count_nonzero(a.mask == 255), np.count_nonzero(b.mask == 255)))
    shared = int(np.count_nonzero(both))
    if shared < _MIN_SHARED_PIXELS:
        return Agreement(math.nan, shared / max(1, smaller), math.nan)
    correlation = _correlation(a.image, moved, both)
    patches, telling = _patch_correlations(a.image, moved, both, _PATCH_PIXELS, _telling_gray(a, b))
    confirmed = math.nan
    if np.count_nonzero(telling) >= _MIN_PATCHES:
        agree = patches > _PATCH_CORRELATION
        confirmed = float(np.mean(agree[telling]))
    return Agreement(correlation, shared / smaller, confirmed)


def _correlation(first: UInt8Array, second: UInt8Array, both: BoolArray) -> float:
    """Return the correlation of two pictures where both count; 0 where either is even."""
    count = np.count_nonzero(both)
    mask = both.view(np.uint8)
    seen_a, seen_b = cv2.multiply(first, mask), cv2.multiply(second, mask)
    # From sums of bytes, which are exact and quick; that of the products is half of what the
    # squares have over the difference's.
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
    """Return which share of the patches that tell speak clearly for one motion, and for its rival.

    Where a floor repeats, both motions explain nearly all of it; scratches, stains and wear tell
    them apart, by a little in each of many patches. What agrees under the one alone may be a leg,
    and is no word for it. nan where too few patches tell of both.

    Parameters
    ----------
    a, b : PyramidLevel
        The second of each pyramid.
    view_a_from_view_b, rival : (3, 3) float64
    """
    side, least = _PREFERENCE_PATCH_PIXELS, _telling_gray(a, b, _HALVED_NOISE)
    laid_over = _laid_over(a, b, view_a_from_view_b)
    first, telling = _patch_correlations(a.image, *laid_over, side, least)
    second, also = _patch_correlations(a.image, *_laid_over(a, b, rival), side, least)
    both = telling & also
    count = np.count_nonzero(both)
    if count < _MIN_PATCHES:
        return math.nan, math.nan
    pro = both & (first > np.maximum(second + _BETTER, _WELL)) & (second > _PATCH_CORRELATION)
    contra = both & (second > np.maximum(first + _BETTER, _WELL))
    return float(np.count_nonzero(pro) / count), float(np.count_nonzero(contra) / count)


def keep_agreeing_points(
    levels_a: Sequence[PyramidLevel], b: PyramidLevel, view_a_from_view_b: Float64Array
) -> tuple[PyramidLevel, ...]:
    """Return levels of view a with those points alone that lie in patches which agree with b.

    What stands or walks on the floor has no say then.

    Parameters
    ----------
    levels_a : sequence of PyramidLevel
        From fine to coarse.
    b : PyramidLevel
        The finest of the other view.
    view_a_from_view_b : (3, 3) float64
    """
    finest = levels_a[0]
    patches, telling = _patch_correlations(
        finest.image,
        *_laid_over(finest, b, view_a_from_view_b),
        _PATCH_PIXELS,
        _telling_gray(finest, b),
    )
    rows, columns = (side // _PATCH_PIXELS for side in finest.image.shape)
    agree = (telling & (patches > _PATCH_CORRELATION)).reshape(rows, columns)
    kept = []
    for level in levels_a:
        pixels = apply_homography(finest.pixel_from_metres, level.points)
        column, row = np.floor_divide(np.rint(pixels), _PATCH_PIXELS).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        inside[inside] = agree[row[inside], column[inside]]
        kept.append(
            replace(
                level,
                points=level.points[inside],
                values=level.values[inside],
                gradients=level.gradients[inside],
            )
        )
    return tuple(kept)


def _laid_over(
    a: PyramidLevel, b: PyramidLevel, view_a_from_view_b: Float64Array
) -> tuple[UInt8Array, BoolArray]:
    """Return b's picture as a sees it, and where both see the floor."""
    b_from_a_pixel = invert(view_a_from_view_b) @ invert(a.pixel_from_metres)
    b_pixel_from_a_pixel = b.pixel_from_metres @ b_from_a_pixel
    size = (a.image.shape[1], a.image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpPerspective(b.image, b_pixel_from_a_pixel, size, flags=flags)
    seen = cv2.warpPerspective(b.mask, b_pixel_from_a_pixel, size, flags=flags)
    return np.asarray(moved, np.uint8), (np.asarray(seen) == 255) & (a.mask == 255)


def _telling_gray(a: PyramidLevel, b: PyramidLevel, noise_share: float = 1.0) -> float:
    """Return by how much a patch must vary to tell something, where so much noise is left."""
    noise_gray = noise_share * max(a.frame_noise_gray, b.frame_noise_gray)
    return max(_TELLING_GRAY, _TELLING_NOISE_SHARE * noise_gray)


def _patch_correlations(
    image_a: UInt8Array,
    image_b: UInt8Array,
    both: BoolArray,
    side: int,
    telling_gray: float,
) -> tuple[Float32Array, BoolArray]:
    """Return each patch's own correlation, and whether it is whole and shows more than noise."""
    rows, columns = (whole - whole % side for whole in both.shape)
    first, second, weight = (
        picture[:rows, :columns]
        .reshape(rows // side, side, columns // side, side)
        .transpose(0, 2, 1, 3)
        .reshape(-1, side**2)
        for picture in (image_a, image_b, both)
    )
    whole = weight.all(axis=1)
    correlation = np.zeros(len(first), np.float32)
    telling = np.zeros(len(first), np.bool_)
    patch_a, patch_b = first[whole].astype(np.float32), second[whole].astype(np.float32)
    patch_a -= patch_a.mean(axis=1, keepdims=True)
    patch_b -= patch_b.mean(axis=1, keepdims=True)
    energy_a, energy_b = (patch_a**2).mean(axis=1), (patch_b**2).mean(axis=1)
    telling[whole] = np.maximum(energy_a, energy_b) > telling_gray**2
    norm = np.sqrt(np.maximum(energy_a * energy_b, np.float32(1e-6)))
    correlation[whole] = (patch_a * patch_b).mean(axis=1) / norm
    return correlation, telling
