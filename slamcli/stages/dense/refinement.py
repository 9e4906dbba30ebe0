"""Two views compared pixel by pixel: how well they agree, and the rigid motion refined.

The refinement is an inverse-compositional Lucas-Kanade alignment (Baker and Matthews, IJCV 56,
2004) of a rigid motion with gain and offset, on locally normalised gray, with Huber weights. Each
pixel is weighted by what its brightness may err: noise, and the gradient along the line of sight
times the floor distance that a rocking camera shifts it by.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from slamcli.core.geometry import Pose2, apply_homography
from slamcli.stages import camera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from slamcli.core.records import Calibration, DenseLevel

_MOST_ITERATIONS = 12
_CONVERGED_PIXELS = 0.003
_LEAST_TEMPLATE_PIXELS = 200
_HUBER_SIGMAS = 1.5
# Neighbouring residuals are not independent: interpolation and blur tie about this many together.
_CORRELATED_PIXELS = 16.0
_REMAP_COLUMNS = 256
# A refinement that runs away from the fit that it started at has found something else.
_MOST_SHIFT_PIXELS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A refined motion.

    Attributes
    ----------
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m), theta (rad) in b's own axes.
    """

    a_from_b: Pose2
    covariance: NDArray[np.float64]


def refine(
    levels_a: Sequence[DenseLevel],
    levels_b: Sequence[DenseLevel],
    a_from_b: Pose2,
    calibration: Calibration,
    tilt_sigma_radians: float,
) -> Refinement | None:
    """Refine a motion on the pixels of two views; None when they do not determine it.

    Parameters
    ----------
    levels_a, levels_b : sequence of DenseLevel
        From `make_levels`, of views of one resolution.
    a_from_b : Pose2
        A start within a few pixels of the truth.
    tilt_sigma_radians : float
        By how much the camera's pitch varies from frame to frame.
    """
    pose, result = a_from_b, None
    for level_a, level_b in zip(reversed(levels_a), reversed(levels_b), strict=True):
        if len(level_a.points) < _LEAST_TEMPLATE_PIXELS:
            return None
        result = _refine_level(level_a, level_b, pose, calibration, tilt_sigma_radians)
        if result is None:
            return None
        pose = result.a_from_b
    moved = (a_from_b.inverse() @ pose).translation_length
    if moved > _MOST_SHIFT_PIXELS * levels_a[-1].metres_per_pixel:
        return None
    return result


def _refine_level(
    a: DenseLevel,
    b: DenseLevel,
    a_from_b: Pose2,
    calibration: Calibration,
    tilt_sigma_radians: float,
) -> Refinement | None:
    pose = a_from_b
    for _ in range(_MOST_ITERATIONS):
        points_b = pose.inverse().apply(a.points)
        pixels_b = apply_homography(b.pixel_from_metres, points_b)
        seen = _sample(b.inside, pixels_b) > 254.5
        if np.count_nonzero(seen) < _LEAST_TEMPLATE_PIXELS:
            return None
        points, pixels = points_b[seen], pixels_b[seen]
        values_b = _sample(b.detail, pixels)
        gradients = a.gradients[seen] @ pose.matrix[:2, :2]
        jacobian = np.column_stack(
            [
                -gradients[:, 0],
                -gradients[:, 1],
                gradients[:, 0] * points[:, 1] - gradients[:, 1] * points[:, 0],
                a.values[seen],
                np.ones(len(points)),
            ]
        )
        residual = values_b - a.values[seen]
        along, _ = camera.line_of_sight_axes(points)
        shift = np.einsum("ni,ni->n", gradients, along) * camera.range_sigma(
            calibration, points, tilt_sigma_radians
        )
        solved = _solve(jacobian, residual, a.shifts[seen] ** 2 + shift**2)
        if solved is None:
            return None
        step, covariance = solved
        pose = pose @ Pose2(float(step[0]), float(step[1]), float(step[2]))
        reach = float(np.abs(points).max())
        moved = math.hypot(step[0], step[1]) + abs(step[2]) * reach
        if moved < _CONVERGED_PIXELS * b.metres_per_pixel:
            break
    return Refinement(pose, covariance)


def _solve(
    jacobian: NDArray[np.float64],
    residual: NDArray[np.float64],
    model_variance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return one robust Gauss-Newton step (5,) and the covariance (3, 3) of its motion part."""
    noise = 1.4826 * float(np.median(np.abs(residual - np.median(residual)))) + 1e-6
    variance = noise**2 + model_variance
    standardised = np.abs(residual) / np.sqrt(variance)
    weight = np.minimum(1.0, _HUBER_SIGMAS / np.maximum(standardised, 1e-12)) / variance
    weighted = jacobian * weight[:, None]
    information = jacobian.T @ weighted
    try:
        step = -np.linalg.solve(information, weighted.T @ residual)
        covariance = np.linalg.inv(information)[:3, :3] * _CORRELATED_PIXELS
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(step).all() and np.all(np.diag(covariance) > 0)):
        return None
    return np.asarray(step, np.float64), np.asarray(covariance, np.float64)


def _sample(
    image: NDArray[np.float32] | NDArray[np.uint8], pixels: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate (h, w) at (N, 2) pixels; 0 outside. Folded, as remap limits its maps' sides."""
    count = len(pixels)
    rows = -(-count // _REMAP_COLUMNS)
    folded = np.full((2, rows * _REMAP_COLUMNS), -1e4, dtype=np.float32)
    folded[:, :count] = pixels.T
    columns_map, rows_map = folded.reshape(2, rows, _REMAP_COLUMNS)
    sampled = cv2.remap(image, columns_map, rows_map, cv2.INTER_LINEAR)
    return np.asarray(sampled, dtype=np.float64).ravel()[:count]
