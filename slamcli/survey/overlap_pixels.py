"""Verification of an overlap by its pixels: correlation, and the share that shows unrelated floor.

A motion that fits many matches may still be false: a photograph whose parts were copied, a floor
of boards with few prints. Then a part of the overlap is alike and the rest is unrelated. Relief
shifts the rest by parallax, though, so blocks of it are looked for nearby (block matching), and
what they reach there is compared with what they reach elsewhere in the picture, by chance.
"""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, IntpArray
from slamcli.core.geometry import invert
from slamcli.survey.features import SurveyFeatures

_MIN_OVERLAP_PIXELS = 50
# An overlap is contradicted where more of it than this looks like unrelated floor
# [benchmarks/real_sets.py: 0.31 at most in right maps, over relief of seabeds, crops and dunes, 0
# over flat floors; false pairs of copied texture have 0 to 1.1, 1 where all is unrelated].
MAX_UNRELATED_SHARE = 0.4
# Sides, spacing and search of the blocks, pixels of the small pictures of 200. With fewer blocks
# than this nothing is concluded. [guarded by benchmarks/real_sets.py]
_BLOCK, _STEP, _SEARCH, _MIN_BLOCKS = 20, 10, 8, 12
# Blocks have this mean square in both small pictures, which noise of 2.5 gray does not reach, and
# these show the floor at scales that differ by this factor at most: else one is blurred.
_MIN_ENERGY, _MAX_SCALE = 0.4, 2.0
# What blocks reach by chance is lower than this; over floor that repeats they reach more elsewhere.
_MAX_CHANCE_CORRELATION = 0.5
# Compared with a place that is different where this many pixels lie between.
_APART = _BLOCK + _SEARCH
# The place that a block is compared with is this many of all blocks further, so that it is not
# the next one.
_STRIDE = 7


def correlation(
    first: SurveyFeatures, second: SurveyFeatures, a_from_b: Float64Array
) -> tuple[float, float]:
    """Return the correlation of the overlap's pixels, and its share of the first picture."""
    warped, seen = _aligned(first, second, _to_first(first, second, a_from_b))
    count = int(seen.sum())
    if count < _MIN_OVERLAP_PIXELS:
        return 0.0, count / seen.size
    x, y = first.thumbnail[seen].astype(np.float64), warped[seen].astype(np.float64)
    x, y = x - x.mean(), y - y.mean()
    energy = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / max(energy, 1e-9), count / seen.size


def unrelated_share(first: SurveyFeatures, second: SurveyFeatures, a_from_b: Float64Array) -> float:
    """Return an estimate of the share of an overlap that shows unrelated floor in the two frames.

    Twice the share of blocks that agree less than the median of those looked for elsewhere; 0 when
    there are too few.

    Parameters
    ----------
    a_from_b : (3, 3) float64
        Homography between pixels from the pictures' middles.
    """
    to_first = _to_first(first, second, a_from_b)
    warped, seen = _aligned(first, second, to_first)
    blocks = _blocks(first.thumbnail, warped, seen, to_first)
    own = np.array([_best(first.thumbnail, warped, block, block) for block in blocks])
    chance = [
        _best(first.thumbnail, warped, block, far[_STRIDE * number % len(far)])
        for number, block in enumerate(blocks)
        if len(far := blocks[np.abs(blocks - block).max(axis=1) > _APART])
    ]
    if len(chance) < _MIN_BLOCKS:
        return 0.0
    level = min(float(np.median(chance)), _MAX_CHANCE_CORRELATION)
    return 2.0 * float(np.mean(own < level))


def _to_first(
    first: SurveyFeatures, second: SurveyFeatures, a_from_b: Float64Array
) -> Float64Array:
    return first.thumbnail_from_image @ a_from_b @ invert(second.thumbnail_from_image)


def _aligned(
    first: SurveyFeatures, second: SurveyFeatures, to_first: Float64Array
) -> tuple[Float32Array, BoolArray]:
    """Return the second small picture as the first sees it, and where both are known."""
    size = first.thumbnail.shape[::-1]
    warped = np.asarray(cv2.warpPerspective(second.thumbnail, to_first, size), np.float32)
    known = (second.thumbnail != 0.0).astype(np.float32)
    seen = np.asarray(cv2.warpPerspective(known, to_first, size)) > 0.99
    return warped, seen & (first.thumbnail != 0.0)


def _blocks(
    first: Float32Array, warped: Float32Array, seen: BoolArray, to_first: Float64Array
) -> IntpArray:
    """Return (N, 2) rows and columns of the upper left corners of the blocks to compare."""
    height, width = first.shape
    rows, columns = (
        part.ravel()
        for part in np.meshgrid(
            np.arange(_SEARCH, height - _BLOCK - _SEARCH, _STEP),
            np.arange(_SEARCH, width - _BLOCK - _SEARCH, _STEP),
            indexing="ij",
        )
    )

    def mean(values: Float32Array) -> Float64Array:
        sums = cv2.integral(values)
        right, below = columns + _BLOCK, rows + _BLOCK
        inside = sums[below, right] - sums[rows, right] - sums[below, columns] + sums[rows, columns]
        return np.asarray(inside, np.float64) / _BLOCK**2

    shared = seen.astype(np.float32)
    usable = mean(shared) > 0.95
    usable &= np.minimum(mean(first**2), mean(warped**2 * shared)) > _MIN_ENERGY
    middles = np.column_stack([columns + _BLOCK / 2, rows + _BLOCK / 2, np.ones(len(rows))])
    # The determinant of a homography's Jacobian is that of the matrix over the cube of the depth.
    back = invert(to_first)
    area = np.abs(np.linalg.det(back) / (middles @ back[2]) ** 3)
    usable &= (area < _MAX_SCALE**2) & (area > _MAX_SCALE**-2)
    return np.column_stack([rows, columns])[usable]


def _best(first: Float32Array, warped: Float32Array, block: IntpArray, place: IntpArray) -> float:
    """Return the highest correlation of a block of the second picture near a place of the first."""
    row, column = block
    template = warped[row : row + _BLOCK, column : column + _BLOCK]
    row, column = place - _SEARCH
    side = _BLOCK + 2 * _SEARCH
    around = first[row : row + side, column : column + side]
    return float(cv2.matchTemplate(around, template, cv2.TM_CCOEFF_NORMED).max())
