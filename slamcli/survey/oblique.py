"""An oblique camera calibrated by the floor alone: focal length, pitch and roll from its motions.

A camera fixed on a vehicle sees the same floor from step to step under homographies that all come
from one mounting: with the right focal length, pitch and roll every pair of frames is a rigid
motion on the floor (self-calibration from planar homographies, Triggs, ECCV 1998). The scale is not
determined: the camera's height is the unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Complex128Array, Float64Array, IntpArray
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import apply_homography, invert
from slamcli.survey.features import SurveyFeatures
from slamcli.survey.oblique_camera import (
    BEND_PRIOR_SIGMA,
    FOCAL_PRIOR_SIGMA,
    NOTED_FOCAL_SIGMA,
    ROLL_PRIOR_SIGMA,
    ObliqueCamera,
    undistorted,
)
from slamcli.survey.pairs import match, plausible

# [All thresholds here: guarded by benchmarks/real_sets.py.]
_THRESHOLD_SHARE, _MAX_ITERATIONS, _CONFIDENCE = 0.002, 3000, 0.9999
# A second motion has so many matches, and lies apart from the first in rows.
_MIN_MATCHES, _APART_FACTOR, _ROW_PERCENTILES = 25, 4.0, (10.0, 90.0)
# Starts of the search: pitch in degrees, and focal length in widths of the picture.
_PITCHES, _FOCALS = (15.0, 30.0, 45.0, 60.0), (0.6, 0.9, 1.3)
_BEHIND_PIXELS, _LOSS_PIXELS = 1e3, 1.5
_ROUGH_MATCHES, _ROUGH_STEPS, _MAX_MATCHES = 25, 12, 120
_MIN_MOTIONS, _MAX_RESIDUAL_SHARE = 3, 0.002


@dataclass(frozen=True, slots=True, eq=False)
class FloorMotion:
    """Matches of the floor between two frames.

    Attributes
    ----------
    pixels_a, pixels_b : (N, 2) float64
        From the pictures' middles.
    apart : bool
        Whether the floor moves in other rows, further down, than what else the frames show.
    residual_pixels : float
        Median error under a homography of its own.
    """

    pixels_a: Float64Array
    pixels_b: Float64Array
    apart: bool
    residual_pixels: float


def floor_motion(first: SurveyFeatures, second: SurveyFeatures) -> FloorMotion | None:
    """Return the lowest motion that two frames have in common; None when there is none."""
    points_a, points_b = match(first, second)
    left = np.ones(len(points_a), np.bool_)
    threshold = _THRESHOLD_SHARE * max(first.size)
    motions: list[tuple[Float64Array, BoolArray]] = []
    for _ in range(3):
        found = _dominant(points_a, points_b, left, threshold)
        if found is None:
            break
        homography, inliers = found
        motions.append((homography, inliers))
        errors = np.linalg.norm(apply_homography(homography, points_b) - points_a, axis=1)
        left &= ~(errors < _APART_FACTOR * threshold)
    if not motions:
        return None
    rows = [np.percentile(points_a[inliers, 1], _ROW_PERCENTILES) for _, inliers in motions]
    lowest = max(range(len(motions)), key=lambda number: float(rows[number].sum()))
    apart = lowest > 0 and rows[lowest][0] > rows[0][1] - 0.05 * first.size[1]
    homography, chosen = motions[lowest if apart else 0]
    some, others = points_a[chosen], points_b[chosen]
    errors = np.linalg.norm(apply_homography(homography, others) - some, axis=1)
    return FloorMotion(some, others, bool(apart), float(np.median(errors)))


def _dominant(
    points_a: Float64Array, points_b: Float64Array, left: BoolArray, threshold: float
) -> tuple[Float64Array, BoolArray] | None:
    """Return the homography that most of the matches left agree with, and which do."""
    numbers = np.flatnonzero(left)
    if len(numbers) < _MIN_MATCHES:
        return None
    found, mask = cv2.findHomography(
        points_b[numbers],
        points_a[numbers],
        cv2.USAC_MAGSAC,
        threshold,
        None,
        _MAX_ITERATIONS,
        _CONFIDENCE,
    )
    if found is None:
        return None
    inliers = np.zeros(len(points_a), np.bool_)
    inliers[numbers[np.asarray(mask).ravel() > 0]] = True
    homography = np.asarray(found, np.float64)
    if inliers.sum() < _MIN_MATCHES or not plausible(homography, points_b[inliers]):
        return None
    return homography, inliers


@dataclass(frozen=True, slots=True)
class _FocalPrior:
    """The prior of the logarithm of the focal length in widths of the picture."""

    log_widths: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _Matches:
    """Matches of several motions: (2, M, 2) pixels in both frames, and (M,) the motion of each."""

    pixels: Float64Array
    motion: IntpArray

    @classmethod
    def of(cls, motions: Sequence[FloorMotion], count: int) -> _Matches:
        """Return at most so many matches of each motion."""
        steps = [-(-len(one.pixels_a) // count) for one in motions]
        pixels = [
            np.concatenate([side[::step] for side, step in zip(sides, steps, strict=True)])
            for sides in ([one.pixels_a for one in motions], [one.pixels_b for one in motions])
        ]
        lengths = [len(one.pixels_a[::step]) for one, step in zip(motions, steps, strict=True)]
        return cls(np.stack(pixels), np.repeat(np.arange(len(motions)), lengths))

    def residuals(self, values: Float64Array, width: int) -> Float64Array:
        """Return (M, 2) pixels: the second frame's points, by the best rigid motion, in the first.

        Of a motion that the camera does not see on the floor they are all large.
        """
        log_focal, pitch, roll, k1 = values.tolist()
        focal = width * math.exp(log_focal)
        image_from_floor = image_from_robot_homography(
            np.diag([focal, focal, 1.0]), 1.0, pitch, roll
        )
        floor_from_image = invert(image_from_floor)
        seen = undistorted(self.pixels.reshape(-1, 2), k1, focal).reshape(self.pixels.shape)
        depths = seen @ floor_from_image[2, :2] + floor_from_image[2, 2]
        below = (depths > 1e-6).all(axis=0)
        # An error of a pixel far away is one of much floor.
        with np.errstate(over="ignore", invalid="ignore"):
            weights = np.where(below, depths.min(axis=0), 0.0) ** 4
        finite = np.isfinite(np.bincount(self.motion, weights))
        used = below & (finite & (np.bincount(self.motion, below) >= 2))[self.motion]
        floor = apply_homography(floor_from_image, seen[:, used])
        moved = _rigidly_moved(floor, self.motion[used], weights[used])
        residual = np.full(self.pixels.shape[1:], _BEHIND_PIXELS)
        residual[used] = apply_homography(image_from_floor, moved) - seen[0][used]
        residual = np.nan_to_num(residual, nan=_BEHIND_PIXELS)
        return np.asarray(np.clip(residual, -_BEHIND_PIXELS, _BEHIND_PIXELS), np.float64)


def _rigidly_moved(floor: Float64Array, group: IntpArray, weights: Float64Array) -> Float64Array:
    """Return (N, 2) the second of (2, N, 2) points, moved to the first rigidly, group by group.

    In closed form, as `fit_rigid_2d`.
    """

    def mean(values: Complex128Array) -> Complex128Array:
        real, imaginary = (np.bincount(group, weights * v) for v in (values.real, values.imag))
        return np.asarray((real + 1j * imaginary) / total, np.complex128)

    total = np.maximum(np.bincount(group, weights), np.finfo(np.float64).tiny)
    first, second = floor @ [1.0, 1.0j]
    centres = mean(first), mean(second)
    first, second = first - centres[0][group], second - centres[1][group]
    turn = mean(first * second.conj())
    turn = np.where(turn == 0.0, 1.0, turn / np.maximum(np.abs(turn), np.finfo(np.float64).tiny))
    moved = centres[0][group] + turn[group] * second
    return np.column_stack([moved.real, moved.imag])


def estimate_camera(
    motions: Sequence[FloorMotion],
    size: tuple[int, int],
    focal_pixels: float | None = None,
    focal_sigma: float = NOTED_FOCAL_SIGMA,
) -> ObliqueCamera:
    """Return the camera under which all motions are rigid on the floor.

    Parameters
    ----------
    motions : sequence of FloorMotion
    size : (int, int)
        Of the pictures.
    focal_pixels : float or None
        As photos note it, about right.
    focal_sigma : float
        Of its logarithm.
    """
    if len(motions) < _MIN_MOTIONS:
        return _none("too few pairs of frames show the same floor")
    width = max(size)
    prior = _FocalPrior(0.0, FOCAL_PRIOR_SIGMA)
    focals: tuple[float, ...] = _FOCALS
    if focal_pixels is not None:
        prior = _FocalPrior(math.log(focal_pixels / width), focal_sigma)
        focals = (focal_pixels / width,)
    starts = [
        np.array([math.log(focal), math.radians(pitch), 0.0, 0.0])
        for focal, pitch in product(focals, _PITCHES)
    ]
    few, most = (_Matches.of(motions, count) for count in (_ROUGH_MATCHES, _MAX_MATCHES))
    rough = [_solved(few, width, start, prior, _ROUGH_STEPS) for start in starts]
    best = min(rough, key=lambda one: one.cost)
    best = _solved(most, width, best.values, prior)
    every = _Matches.of(motions, max(len(one.pixels_a) for one in motions))
    median = float(np.median(np.linalg.norm(every.residuals(best.values, width), axis=1)))
    noise = max(median / 1.18, 0.05) / _LOSS_PIXELS
    covariance = noise**2 * np.linalg.pinv(best.jacobian.T @ best.jacobian)
    sigmas = np.sqrt(np.diag(covariance))
    focal, pitch, roll, bend = best.values.tolist()
    camera = ObliqueCamera(
        width * math.exp(focal), pitch, roll, bend, float(sigmas[0]), float(sigmas[1]), median
    )
    return _checked(camera, width)


class _Solution(NamedTuple):
    """The solution of a least-squares problem: its values (K,), its cost, its Jacobian (N, K)."""

    values: Float64Array
    cost: float
    jacobian: Float64Array


def _solved(
    matches: _Matches,
    width: int,
    start: Float64Array,
    focal: _FocalPrior,
    steps: int | None = None,
) -> _Solution:
    """Return the least squares of log focal length (widths), pitch, roll and k1, from a start."""

    def misfit(values: Float64Array) -> Float64Array:
        residual = matches.residuals(values, width).ravel() / _LOSS_PIXELS
        prior = [
            (values[0] - focal.log_widths) / focal.sigma,
            values[2] / ROLL_PRIOR_SIGMA,
            values[3] / BEND_PRIOR_SIGMA,
        ]
        return np.concatenate([residual, prior])

    # Slow to load, and needed for cameras without a calibration alone.
    from scipy.optimize import least_squares

    found = least_squares(misfit, start, loss="cauchy", x_scale="jac", max_nfev=steps)
    return _Solution(np.asarray(found.x), float(found.cost), np.asarray(found.jac, np.float64))


def _checked(camera: ObliqueCamera, width: int) -> ObliqueCamera:
    if camera.median_pixels <= _MAX_RESIDUAL_SHARE * width:
        return camera.checked()
    reason = (
        "no fixed camera over a flat floor explains the motions "
        f"({camera.median_pixels:.1f} px left)"
    )
    return replace(camera, reason=reason)


def _none(reason: str) -> ObliqueCamera:
    return ObliqueCamera(math.nan, math.nan, math.nan, 0.0, math.nan, math.nan, math.nan, reason)
