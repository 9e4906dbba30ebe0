"""Exposure estimation: frames' gains and the lens's vignetting, from floor seen repeatedly."""

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

# The floor is sampled at this many points along the usable range
# [guarded by benchmarks/blends.py, as all below].
_SAMPLES_ALONG_RANGE = 24
# First with Huber's weights, which converge from any start, then with Tukey's biweight, on which
# what is not floor has no influence; each at 95 % efficiency. One sigma is 3 % of brightness.
_ITERATIONS, _HUBER_ITERATIONS = 12, 6
_HUBER, _TUKEY = 1.345, 4.685
_MIN_WEIGHT = 1e-3
_SIGMA = 0.03
# At most this many samples, drawn at random, of one point of the floor: more add no information,
# and all of them, over a floor driven on all day, would take more memory than the map
# [benchmarks/scale.py].
_MAX_SAMPLES_A_POINT = 16
# Priors of log gain and of the vignetting's coefficients: without evidence every gain is 1 and the
# lens is even.
_GAIN_SIGMA, _VIGNETTING_SIGMA = 1.0, 0.5
_DARKEST_GRAY, _BRIGHTEST_GRAY = 8.0, 245.0
# At most this share of the floor may become brighter than that by the gains: all are lowered alike.
_MAX_BRIGHTEST_SHARE = 0.005
_BLUR_SHARE = 1 / 80
# A smaller change of the log brightness is invisible, and not worth the time to apply it.
_MIN_CHANGE = 0.004
# An estimate below this many standard deviations is noise.
_SIGNIFICANT_SIGMAS = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class FloorBrightness:
    """Brightness of the floor in one frame, at the points at which all frames are compared.

    Attributes
    ----------
    points : (M, 2) int32
        In units of `comparison_step`, in the map.
    logarithm : (M,) float64
        Of the mean gray.
    radius_squared : (M,) float32
        From the image centre; 1 in the corners.
    weight : (M,) float32
        1 where the floor is plain, the less the more contrast there is.
    """

    points: Int32Array
    logarithm: Float64Array
    radius_squared: Float32Array
    weight: Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """Gain of each frame, and the vignetting that all share.

    Attributes
    ----------
    gains : (N,) float64
        What a frame's pixels are to be multiplied by.
    vignetting : (float, float)
        a, b: the logarithm of the brightness falls by a r^2 + b r^4, r = 1 in the corners.
    """

    gains: Float64Array
    vignetting: tuple[float, float] = (0.0, 0.0)


def no_brightness() -> FloorBrightness:
    """Return the empty observation of a frame that cannot be read."""
    none = np.zeros(0, np.float32)
    return FloorBrightness(np.zeros((0, 2), np.int32), np.zeros(0), none, none)


def comparison_step(calibration: Calibration) -> float:
    """Return the metres between the points of the floor at which frames are compared."""
    return calibration.max_range_metres / _SAMPLES_ALONG_RANGE


def thumbnail(gray: UInt8Array) -> UInt8Array:
    """Return an image (H, W) reduced to a quarter each way, enough to read its brightness from."""
    height, width = gray.shape
    small = cv2.resize(gray, (-(-width // 4), -(-height // 4)), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def observe(
    gray: UInt8Array,
    calibration: Calibration,
    hull: Float64Array,
    map_from_robot: Pose2,
    step_metres: float,
) -> FloorBrightness:
    """Return the brightness of the floor at the points that a frame sees.

    Parameters
    ----------
    gray : (h, w) uint8
        The frame's image; may be smaller than the calibration's, of the same shape.
    hull : (N, 2) float64
        `footprint_hull` of the calibration, or of one much like it.
    """
    corners = map_from_robot.apply(hull) / step_metres
    low, high = np.floor(corners.min(axis=0)).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    columns, rows = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    points = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.int64)
    floor = map_from_robot.inverse().apply(points * step_metres)
    pixels, seen = project_floor(calibration, floor)
    points, pixels = points[seen], pixels[seen]
    width, height = calibration.image_size
    side = max(3, round(gray.shape[1] * _BLUR_SHARE) | 1)
    values = gray.astype(np.float32)
    mean, square = cv2.blur(values, (side, side)), cv2.blur(values * values, (side, side))
    scale = np.array([(gray.shape[1] - 1) / (width - 1), (gray.shape[0] - 1) / (height - 1)])
    index = np.rint(pixels * scale).astype(int)
    level = mean[index[:, 1], index[:, 0]].astype(np.float64)
    variance = np.maximum(square[index[:, 1], index[:, 0]] - level**2, 0.0)
    centre = np.array(image_centre(calibration.image_size))
    radius_squared = np.sum((pixels - centre) ** 2, axis=1) / float(centre @ centre)
    usable = (level > _DARKEST_GRAY) & (level < _BRIGHTEST_GRAY)
    contrast = np.sqrt(variance[usable]) / level[usable]
    return FloorBrightness(
        points[usable].astype(np.int32),
        np.log(level[usable]),
        radius_squared[usable].astype(np.float32),
        (1.0 / (1.0 + (contrast / (4 * _SIGMA)) ** 2)).astype(np.float32),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The samples of all frames as the equations ``logarithm + design @ x = floor @ y``.

    Attributes
    ----------
    frames : int
        The unknowns x are a log gain per frame, and the two coefficients of the vignetting; the
        unknowns y are the log brightness of each point of the floor.
    design : (N, frames + 2) sparse float64
    floor : (N, points) sparse float64
    point : (N,) int64
        Column of `floor`.
    logarithm, weight : (N,) float64
        Of the gray that was seen; how plain the floor is there.
    """

    frames: int
    design: sparse.csr_array
    floor: sparse.csr_array
    point: Int64Array
    logarithm: Float64Array
    weight: Float64Array

    @property
    def prior(self) -> Float64Array:
        """Information (frames + 2,) that ties each of x to 0."""
        prior = np.full(self.frames + 2, (_SIGMA / _GAIN_SIGMA) ** 2)
        prior[self.frames :] = (_SIGMA / _VIGNETTING_SIGMA) ** 2
        return prior

    def residuals(self, solution: Float64Array, weight: Float64Array) -> Float64Array:
        """Return (N,): how far each corrected sample lies from its point's weighted mean."""
        corrected = self.logarithm + self.design @ solution
        mean = np.bincount(self.point, weight * corrected) / np.bincount(self.point, weight)
        return np.asarray(corrected - mean[self.point], np.float64)


def estimate_exposure(observations: Sequence[FloorBrightness]) -> Exposure:
    """Return the exposure under which all frames agree best on the floor's brightness.

    Robust least squares on logarithms: log I = floor(point) - gain(frame) - a r^2 - b r^4, by
    iteratively reweighted normal equations, the floor eliminated (after
    Goldman, IEEE TPAMI 32(12), 2010, who solves for vignetting and exposure on panoramas; the
    response is taken as linear). The median gain is 1, or less where bright floor would clip.
    """
    frames = len(observations)
    if sum(len(one.logarithm) for one in observations) == 0:
        return Exposure(np.ones(frames))
    problem = _make_problem(observations)
    solution = np.zeros(frames + 2)
    weight = problem.weight
    for iteration in range(_ITERATIONS):
        solution = _solve_weighted(problem, weight)
        residual = np.abs(problem.residuals(solution, weight)) / _SIGMA
        if iteration < _HUBER_ITERATIONS:
            weight = problem.weight * np.minimum(1.0, _HUBER / np.maximum(residual, 1e-12))
        else:
            biweight = np.maximum(1.0 - (residual / _TUKEY) ** 2, _MIN_WEIGHT) ** 2
            weight = problem.weight * biweight
    return _significant(problem, solution, weight)


def _make_problem(observations: Sequence[FloorBrightness]) -> _Problem:
    frames = len(observations)
    counts = [len(one.logarithm) for one in observations]
    # One number per point: unique pairs of numbers take several times the memory.
    keys = np.concatenate([_keys(one.points) for one in observations])
    some = _some_of_each(keys, _MAX_SAMPLES_A_POINT)
    frame = np.repeat(np.arange(frames), counts)[some]
    _, point = np.unique(keys[some], return_inverse=True)
    logarithm = np.concatenate([one.logarithm for one in observations])[some]
    radius = np.concatenate([one.radius_squared for one in observations])[some].astype(np.float64)
    weight = np.concatenate([one.weight for one in observations])[some].astype(np.float64)
    rows = np.arange(len(frame))
    second, fourth = np.full(len(frame), frames), np.full(len(frame), frames + 1)
    values = np.concatenate([np.ones(len(frame)), radius, radius**2])
    entries = np.concatenate([rows, rows, rows]), np.concatenate([frame, second, fourth])
    design = sparse.csr_array((values, entries), shape=(len(frame), frames + 2))
    floor = sparse.csr_array((np.ones(len(frame)), (rows, point)))
    return _Problem(frames, design, floor, point, logarithm, weight)


def _significant(problem: _Problem, solution: Float64Array, weight: Float64Array) -> Exposure:
    """Return the exposure, with every gain that may be noise, and such a vignetting, left out."""
    frames, design = problem.frames, problem.design
    spread = math.sqrt(float(np.mean(weight * problem.residuals(solution, weight) ** 2)))
    information = np.asarray(design.multiply(design).T @ weight) + problem.prior
    sigmas = _SIGNIFICANT_SIGMAS * spread / np.sqrt(information)
    logarithms = solution[:frames] - np.median(solution[:frames])
    unsure = np.abs(logarithms) < np.maximum(sigmas[:frames], _MIN_CHANGE)
    logarithms[unsure] = 0.0
    a, b = float(solution[frames]), float(solution[frames + 1])
    fall = max(abs(a * r + b * r * r) for r in (0.25, 0.5, 0.75, 1.0))
    even = fall < max(float(sigmas[frames]), _MIN_CHANGE)
    vignetting = np.zeros(2) if even else np.array([a, b])
    anchor = _anchor(problem, np.concatenate([logarithms, vignetting]))
    return Exposure(np.exp(logarithms + anchor), (float(vignetting[0]), float(vignetting[1])))


def _anchor(problem: _Problem, solution: Float64Array) -> float:
    """Return by how much all log gains are lowered so that hardly any floor clips; 0 for not."""
    if not np.any(solution):
        return 0.0
    corrected = problem.logarithm + problem.design @ solution
    brightest = float(np.quantile(corrected, 1.0 - _MAX_BRIGHTEST_SHARE))
    lowered = math.log(_BRIGHTEST_GRAY) - brightest
    return lowered if lowered < -_MIN_CHANGE else 0.0


def _solve_weighted(problem: _Problem, weight: Float64Array) -> Float64Array:
    """Return the x of the least ``sum w (logarithm + design x - floor y)^2 + prior x^2``."""
    design, floor, logarithm = problem.design, problem.floor, problem.logarithm
    weighted = design.multiply(weight[:, None]).tocsr()
    crossed = (weighted.T @ floor).tocsr()
    sums = np.asarray(floor.T @ weight)
    scaled = crossed.multiply(1.0 / sums[None, :]).tocsr()
    normal = weighted.T @ design - scaled @ crossed.T + sparse.diags_array(problem.prior)
    right = -(weighted.T @ logarithm) + scaled @ (floor.T @ (weight * logarithm))
    return np.asarray(spsolve(sparse.csc_array(normal), right), np.float64)


def _keys(points: Int32Array) -> Int64Array:
    """Return (M,) one number for each point."""
    return np.asarray((points[:, 0].astype(np.int64) << 32) + points[:, 1])


def _some_of_each(kind: Int64Array, most: int) -> Int64Array:
    """Return the indices, in order, of at most `most` of each kind, drawn at random."""
    drawn = np.random.default_rng(0).permutation(len(kind))
    order = np.lexsort((drawn, kind))
    ordered = kind[order]
    first = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1]))
    rank = np.arange(len(kind)) - np.repeat(first, np.diff(np.append(first, len(kind))))
    return np.sort(order[rank < most])
