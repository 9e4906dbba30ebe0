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

from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import DenseLevel
from slamcli.stages import camera

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from slamcli.core.records import Calibration, View

# From half the view's resolution on, which already resolves hundredths of a pixel.
_LEVELS = 2
_MOST_ITERATIONS = 12
_CONVERGED_PIXELS = 0.003
_MOST_TEMPLATE_PIXELS = 15_000
_LEAST_TEMPLATE_PIXELS = 200
_HIGH_PASS_PIXELS = 25
_HUBER_SIGMAS = 1.5
# Neighbouring residuals are not independent: interpolation and blur tie about this many together.
_CORRELATED_PIXELS = 16.0
_REMAP_COLUMNS = 256
_OVERLAP_STEP = 16
_SAMPLE_STEP = 16
# A refinement that runs away from the fit that it started at has found something else.
_MOST_SHIFT_PIXELS = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How two overlapping views compare under a motion.

    Attributes
    ----------
    correlation : float
        Zero-mean normalised cross-correlation of the overlap, in [-1, 1].
    overlap : float
        Share of the smaller view's floor that both see.
    """

    correlation: float
    overlap: float


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


def make_levels(
    view: View, calibration: Calibration, tilt_sigma_radians: float
) -> tuple[DenseLevel, ...]:
    """Return a gray view's pyramid, from half resolution on, with what tells most at each level.

    Parameters
    ----------
    tilt_sigma_radians : float
        By how much the camera's pitch varies from frame to frame.
    """
    image, mask = view.image, view.mask
    pixel_from_metres, scale = view.grid.pixel_from_metres, view.grid.metres_per_pixel
    levels = []
    for _ in range(_LEVELS):
        # pyrDown keeps even pixels, so a level's pixel is half the one before's.
        image = np.asarray(cv2.pyrDown(image), np.uint8)
        mask = np.asarray(cv2.pyrDown(mask), np.uint8)
        pixel_from_metres, scale = np.diag([0.5, 0.5, 1.0]) @ pixel_from_metres, 2.0 * scale
        detail, inside = _detail(image, mask)
        right, up = _gradients(detail, scale)
        chosen = _most_telling(np.where(inside == 255, right * right + up * up, np.float32(0.0)))
        rows, columns = np.unravel_index(chosen, detail.shape)
        points = apply_homography(invert(pixel_from_metres), np.column_stack([columns, rows]))
        gradients = np.column_stack([right.ravel()[chosen], up.ravel()[chosen]]).astype(np.float64)
        along, _ = camera.line_of_sight_axes(points)
        shifts = np.einsum("ni,ni->n", gradients, along) * camera.range_sigma(
            calibration, points, tilt_sigma_radians
        )
        values = detail.ravel()[chosen].astype(np.float64)
        levels.append(
            DenseLevel(
                pixel_from_metres,
                scale,
                image,
                mask,
                detail,
                inside,
                points,
                values,
                gradients,
                shifts,
            )
        )
    return tuple(levels)


def agreement(a: DenseLevel, b: DenseLevel, a_from_b: Pose2) -> Agreement:
    """Correlate the overlap of two views, at one level of their pyramids, under ``a_from_b``."""
    b_from_a_pixel = a_from_b.inverse().matrix @ invert(a.pixel_from_metres)
    b_pixel_from_a_pixel = (b.pixel_from_metres @ b_from_a_pixel)[:2]
    size = (a.image.shape[1], a.image.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(b.image, b_pixel_from_a_pixel, size, flags=flags)
    seen = cv2.warpAffine(b.mask, b_pixel_from_a_pixel, size, flags=flags)
    both = (np.asarray(seen) == 255) & (a.mask == 255)
    smaller = int(min(np.count_nonzero(a.mask == 255), np.count_nonzero(b.mask == 255)))
    shared = int(np.count_nonzero(both))
    if shared < _LEAST_TEMPLATE_PIXELS:
        return Agreement(math.nan, shared / max(1, smaller))
    values_a = a.image[both].astype(np.float32)
    values_b = np.asarray(moved)[both].astype(np.float32)
    values_a -= values_a.mean()
    values_b -= values_b.mean()
    norm = math.sqrt(float(values_a @ values_a) * float(values_b @ values_b))
    correlation = float(values_a @ values_b) / norm if norm > 0 else 0.0
    return Agreement(correlation, shared / smaller)


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
    if moved > _MOST_SHIFT_PIXELS * levels_a[0].metres_per_pixel:
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


def _detail(
    image: NDArray[np.uint8], mask: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Take out a picture's slow brightness, which belongs to lamp and lens."""
    inside = (mask == 255).astype(np.float32)
    values = image.astype(np.float32) * inside
    size = (_HIGH_PASS_PIXELS, _HIGH_PASS_PIXELS)
    weight = np.asarray(cv2.blur(inside, size))
    mean = np.asarray(cv2.blur(values, size)) / np.maximum(weight, np.float32(1e-3))
    detail = np.asarray(cv2.GaussianBlur((values - mean) * inside, (3, 3), 0), np.float32)
    # The outermost ring's gradient would be that of the mask, not of the floor.
    eroded = cv2.erode(np.where(mask == 255, np.uint8(255), np.uint8(0)), np.ones((5, 5)))
    return detail, np.asarray(eroded, np.uint8)


def _gradients(
    detail: NDArray[np.float32], metres_per_pixel: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the slopes per metre along x (right) and y (up)."""
    # Scharr's kernel sums to 32 over a span of two pixels' worth of slope.
    scale = 1.0 / (32.0 * metres_per_pixel)
    right = cv2.Scharr(detail, cv2.CV_32F, 1, 0, scale=scale)
    up = cv2.Scharr(detail, cv2.CV_32F, 0, 1, scale=-scale)
    return np.asarray(right, np.float32), np.asarray(up, np.float32)


def _most_telling(strength: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return flat indices of the strongest gradients, by a sample of their distribution."""
    flat = strength.ravel()
    weaker = 1.0 - _MOST_TEMPLATE_PIXELS / flat.size
    least = float(np.quantile(flat[::_SAMPLE_STEP], weaker)) if weaker > 0 else 0.0
    return np.flatnonzero(flat > least)


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
