"""Gain of every frame and the lens's vignetting, solved from the floor that frames share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from slamcli.core.arrays import Float32Array, Float64Array, Int32Array, Int64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.projection import project_floor
from slamcli.core.geometry import Pose2

# Floor is compared at this many places along the usable range.
_PLACES_ALONG_RANGE = 24
# First by Huber's weights, which find their way from anywhere, then by Tukey's biweight, to which
# what is not floor no longer matters; each at 95 % efficiency. One sigma is 3 % of brightness.
_ROUNDS, _HUBER_ROUNDS = 12, 6
_HUBER, _TUKEY = 1.345, 4.685
_MIN_WEIGHT = 1e-3
_SIGMA = 0.03
# Of a place that is seen again and again so many views, any of them, tell as much as is needed; all
# of them, over a floor driven along all day, would take more memory than the map.
_MAX_VIEWS_OF_A_PLACE = 16
# Without anything that speaks for another, every gain is 1 and the lens is even.
_GAIN_SIGMA, _VIGNETTING_SIGMA = 1.0, 0.5
_DARKEST_GRAY, _BRIGHTEST_GRAY = 8.0, 245.0
_NEARLY_WHITE_GRAY = 235.0
_BLUR_SHARE = 1 / 80
# Less than this is not seen, and not worth touching every pixel for.
_NOTHING = 0.004
# So many standard deviations are no accident.
_SIGNIFICANT = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """What one frame shows of the places of the floor that all frames are compared at.

    Attributes
    ----------
    places : (M, 2) int32
        In units of the comparison's step, in the map.
    logarithm : (M,) float64
        Of the mean gray.
    radius_squared : (M,) float32
        From the picture's middle; 1 in its corners.
    weight : (M,) float32
        1 where the floor is plain, less the more contrast there is.
    """

    places: Int32Array
    logarithm: Float64Array
    radius_squared: Float32Array
    weight: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """How bright each frame is.

    Attributes
    ----------
    gains : (N,) float64
        What a frame's pixels are to be multiplied by.
    vignetting : (float, float)
        a, b: the logarithm of the brightness falls by a r^2 + b r^4, r = 1 in the corners.
    """

    gains: Float64Array
    vignetting: tuple[float, float] = (0.0, 0.0)


def nothing_shared() -> Shared:
    """Return what a frame shows that cannot be read."""
    none = np.zeros(0, np.float32)
    return Shared(np.zeros((0, 2), np.int32), np.zeros(0), none, none)


def comparison_step(calibration: Calibration) -> float:
    """Return the metres between the places of the floor at which frames are compared."""
    return calibration.max_range_metres / _PLACES_ALONG_RANGE


def reduced(gray: UInt8Array) -> UInt8Array:
    """Return a picture (H, W) as small as its brightness can be read from: a quarter each way."""
    height, width = gray.shape
    small = cv2.resize(gray, (-(-width // 4), -(-height // 4)), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def observe(
    gray: UInt8Array,
    calibration: Calibration,
    hull: Float64Array,
    map_from_robot: Pose2,
    step_metres: float,
) -> Shared:
    """Read the brightness of the floor at the places that a frame sees.

    Parameters
    ----------
    gray : (h, w) uint8
        The frame's picture; may be smaller than the calibration's, of the same shape.
    hull : (N, 2) float64
        `camera.footprint_hull` of the calibration, or of one much like it.
    """
    corners = map_from_robot.apply(hull) / step_metres
    low, high = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    places = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.int64)
    floor = map_from_robot.inverse().apply(places * step_metres)
    pixels, seen = project_floor(calibration, floor)
    places, pixels = places[seen], pixels[seen]
    width, height = calibration.image_size
    side = max(3, round(gray.shape[1] * _BLUR_SHARE) | 1)
    values = gray.astype(np.float32)
    mean = np.asarray(cv2.blur(values, (side, side)), np.float32)
    square = np.asarray(cv2.blur(values * values, (side, side)), np.float32)
    scale = np.array([(gray.shape[1] - 1) / (width - 1), (gray.shape[0] - 1) / (height - 1)])
    index = np.rint(pixels * scale).astype(int)
    level = mean[index[:, 1], index[:, 0]].astype(np.float64)
    variance = np.maximum(square[index[:, 1], index[:, 0]] - level**2, 0.0)
    centre = np.array(image_centre(calibration.image_size))
    radius_squared = np.sum((pixels - centre) ** 2, axis=1) / float(centre @ centre)
    usable = (level > _DARKEST_GRAY) & (level < _BRIGHTEST_GRAY)
    contrast = np.sqrt(variance[usable]) / level[usable]
    return Shared(
        places[usable].astype(np.int32),
        np.log(level[usable]),
        radius_squared[usable].astype(np.float32),
        (1.0 / (1.0 + (contrast / (4 * _SIGMA)) ** 2)).astype(np.float32),
    )


def solve(observations: Sequence[Shared]) -> Exposure:
    """Return the exposure under which all frames agree best on the floor's brightness.

    Robust least squares on logarithms: log I = floor(place) - gain(frame) - a r^2 - b r^4, by
    iteratively reweighted normal equations, the floor eliminated (after
    Goldman, IEEE TPAMI 32(12), 2010, who solves for vignetting and exposure on panoramas; the
    response is taken as linear). The median gain is 1.
    """
    frames = len(observations)
    counts = [len(one.logarithm) for one in observations]
    if frames == 0 or sum(counts) == 0:
        return Exposure(np.ones(frames))
    # One number a place: to tell pairs apart takes several times the memory.
    keys = np.concatenate([_keys(one.places) for one in observations])
    some = _some_of_each(keys, _MAX_VIEWS_OF_A_PLACE)
    frame = np.repeat(np.arange(frames), counts)[some]
    _, place = np.unique(keys[some], return_inverse=True)
    logarithm = np.concatenate([one.logarithm for one in observations])[some]
    radius = np.concatenate([one.radius_squared for one in observations])[some].astype(np.float64)
    trust = np.concatenate([one.weight for one in observations])[some].astype(np.float64)
    rows = np.arange(len(frame))
    even, fourth = np.full(len(frame), frames), np.full(len(frame), frames + 1)
    design = sparse.csr_array(
        (
            np.concatenate([np.ones(len(frame)), radius, radius**2]),
            (
                np.concatenate([rows, rows, rows]),
                np.concatenate([frame, even, fourth]),
            ),
        ),
        shape=(len(frame), frames + 2),
    )
    floor = sparse.csr_array((np.ones(len(frame)), (rows, place)))
    prior = np.full(frames + 2, (_SIGMA / _GAIN_SIGMA) ** 2)
    prior[frames:] = (_SIGMA / _VIGNETTING_SIGMA) ** 2
    solution = np.zeros(frames + 2)
    weight = trust
    for number in range(_ROUNDS):
        solution = _solve_weighted(design, floor, logarithm, weight, prior)
        corrected = logarithm + design @ solution
        sums = np.bincount(place, weight, minlength=floor.shape[1])
        mean = np.bincount(place, weight * corrected, minlength=floor.shape[1]) / sums
        residual = np.abs(corrected - mean[place]) / _SIGMA
        if number < _HUBER_ROUNDS:
            weight = trust * np.minimum(1.0, _HUBER / np.maximum(residual, 1e-12))
        else:
            weight = trust * np.maximum(1.0 - (residual / _TUKEY) ** 2, _MIN_WEIGHT) ** 2
    # What is not clear of its own uncertainty, at best, is noise: pictures stay as they are.
    corrected = logarithm + design @ solution
    residual = (
        corrected - (np.bincount(place, weight * corrected) / np.bincount(place, weight))[place]
    )
    spread = math.sqrt(float(np.mean(weight * residual**2)))
    information = np.asarray(design.multiply(design).T @ weight) + prior
    sigmas = _SIGNIFICANT * spread / np.sqrt(information)
    logarithms = solution[:frames] - np.median(solution[:frames])
    unsure = np.abs(logarithms) < np.maximum(sigmas[:frames], _NOTHING)
    gains = np.where(unsure, 1.0, np.exp(logarithms))
    a, b = float(solution[frames]), float(solution[frames + 1])
    fall = max(abs(a * r + b * r * r) for r in (0.25, 0.5, 0.75, 1.0))
    nothing = fall < max(float(sigmas[frames]), _NOTHING)
    return Exposure(gains, (0.0, 0.0) if nothing else (a, b))


def _keys(places: Int32Array) -> Int64Array:
    """Return (M,) one number for each place."""
    return np.asarray((places[:, 0].astype(np.int64) << 32) + places[:, 1])


def _some_of_each(kind: Int64Array, most: int) -> Int64Array:
    """Return the numbers, in order, of at most so many of each kind, drawn at random."""
    drawn = np.random.default_rng(0).permutation(len(kind))
    order = np.lexsort((drawn, kind))
    ordered = kind[order]
    first = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    rank = np.arange(len(kind)) - np.repeat(first, np.diff(np.append(first, len(kind))))
    return np.sort(order[rank < most])


def correct(image: UInt8Array, gain: float, brightening: Float32Array | None) -> UInt8Array:
    """Return a picture (h, w, 3) as a lens without vignetting and the common exposure show it.

    Parameters
    ----------
    brightening : (h, w) float32 or None
        What undoes the vignetting, from `brightening_image`; None when the lens is even.
    """
    if gain != 1.0:
        levels = np.arange(256.0)
        # What is saturated was at least so bright: it stays white where the rest is darkened.
        share = np.clip((levels - _NEARLY_WHITE_GRAY) / (255.0 - _NEARLY_WHITE_GRAY), 0.0, 1.0)
        kept = share if gain < 1.0 else np.zeros_like(share)
        table = np.clip(np.rint(levels * (gain + kept * (1.0 - gain))), 0, 255).astype(np.uint8)
        image = np.asarray(cv2.LUT(image, table), np.uint8)
    if brightening is None:
        return image
    factor = cv2.merge([brightening] * 3)
    return np.asarray(cv2.multiply(image, factor, dtype=cv2.CV_8U), np.uint8)


def brightening_image(
    image_size: tuple[int, int], vignetting: tuple[float, float], step: int = 1
) -> Float32Array | None:
    """Return (h, w): what undoes the vignetting, of every so manyth pixel; None when there is none.

    The last row and column lie on the picture's border or beyond it.
    """
    if vignetting == (0.0, 0.0):
        return None
    centre_x, centre_y = image_centre(image_size)
    columns, rows = (step * np.arange(-(-(side - 1) // step) + 1) for side in image_size)
    across, down = (columns - centre_x) ** 2, (rows - centre_y) ** 2
    radius = (across[None, :] + down[:, None]) / (centre_x**2 + centre_y**2)
    return np.exp(vignetting[0] * radius + vignetting[1] * radius**2).astype(np.float32)


def _solve_weighted(
    design: sparse.csr_array,
    floor: sparse.csr_array,
    logarithm: Float64Array,
    weight: Float64Array,
    prior: Float64Array,
) -> Float64Array:
    """Return what minimises sum w (log I + design x - floor(place))^2 + prior x^2 over both."""
    weighted = design.multiply(weight[:, None]).tocsr()
    crossed = (weighted.T @ floor).tocsr()
    sums = np.asarray(floor.T @ weight)
    scaled = crossed.multiply(1.0 / sums[None, :]).tocsr()
    normal = weighted.T @ design - scaled @ crossed.T + sparse.diags_array(prior)
    right = -(weighted.T @ logarithm) + scaled @ (floor.T @ (weight * logarithm))
    return np.asarray(spsolve(sparse.csc_array(normal), right), np.float64)
