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
from slamcli.stages import camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.records import Calibration, View

# Levels of the views' pyramid, coarse to fine; half scale already resolves hundredths of a pixel.
_LEVELS = (2, 1)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Template:
    """The pixels of view a that carry information, at one pyramid level."""

    points: NDArray[np.float64]
    values: NDArray[np.float64]
    gradients: NDArray[np.float64]
    range_sigmas: NDArray[np.float64]


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


def agreement(view_a: View, view_b: View, a_from_b: Pose2) -> Agreement:
    """Correlate the overlap of two gray views, at half resolution, under ``a_from_b``."""
    level = 1
    image_a, mask_a = _shrink(view_a.image, view_a.mask, level)
    image_b, mask_b = _shrink(view_b.image, view_b.mask, level)
    b_from_a_pixel = a_from_b.inverse().matrix @ invert(_pixel_from_metres(view_a, level))
    b_pixel_from_a_pixel = _pixel_from_metres(view_b, level) @ b_from_a_pixel
    size = (image_a.shape[1], image_a.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(image_b, b_pixel_from_a_pixel[:2], size, flags=flags)
    seen = cv2.warpAffine(mask_b, b_pixel_from_a_pixel[:2], size, flags=flags)
    both = (np.asarray(seen) == 255) & (mask_a == 255)
    smaller = int(min(np.count_nonzero(mask_a == 255), np.count_nonzero(mask_b == 255)))
    shared = int(np.count_nonzero(both))
    if shared < _LEAST_TEMPLATE_PIXELS:
        return Agreement(math.nan, shared / max(1, smaller))
    values_a = image_a[both].astype(np.float32)
    values_b = np.asarray(moved)[both].astype(np.float32)
    values_a -= values_a.mean()
    values_b -= values_b.mean()
    norm = math.sqrt(float(values_a @ values_a) * float(values_b @ values_b))
    correlation = float(values_a @ values_b) / norm if norm > 0 else 0.0
    return Agreement(correlation, shared / smaller)


def refine(
    view_a: View,
    view_b: View,
    a_from_b: Pose2,
    calibration: Calibration,
    tilt_sigma_radians: float,
) -> Refinement | None:
    """Refine a motion on the pixels of two gray views; None when they do not determine it.

    Parameters
    ----------
    view_a, view_b : View
        Gray, of one resolution.
    a_from_b : Pose2
        A start within a few pixels of the truth.
    tilt_sigma_radians : float
        By how much the camera's pitch varies from frame to frame.
    """
    pose, result = a_from_b, None
    for level in _LEVELS:
        template = _make_template(view_a, level, calibration, tilt_sigma_radians)
        if template is None:
            return None
        result = _refine_level(template, view_b, pose, level, calibration, tilt_sigma_radians)
        if result is None:
            return None
        pose = result.a_from_b
    moved = (a_from_b.inverse() @ pose).translation_length
    if moved > _MOST_SHIFT_PIXELS * view_a.grid.metres_per_pixel:
        return None
    return result


def _refine_level(
    template: _Template,
    view_b: View,
    a_from_b: Pose2,
    level: int,
    calibration: Calibration,
    tilt_sigma_radians: float,
) -> Refinement | None:
    image_b, mask_b = _normalised(view_b.image, view_b.mask, level)
    pixel_from_metres = _pixel_from_metres(view_b, level)
    metres_per_pixel = view_b.grid.metres_per_pixel * 2**level
    pose = a_from_b
    for _ in range(_MOST_ITERATIONS):
        points_b = pose.inverse().apply(template.points)
        pixels_b = apply_homography(pixel_from_metres, points_b)
        seen = _sample(mask_b, pixels_b) > 254.5
        if np.count_nonzero(seen) < _LEAST_TEMPLATE_PIXELS:
            return None
        points, pixels = points_b[seen], pixels_b[seen]
        values_b = _sample(image_b, pixels)
        rotation = pose.matrix[:2, :2]
        gradients = template.gradients[seen] @ rotation
        jacobian = np.column_stack(
            [
                -gradients[:, 0],
                -gradients[:, 1],
                gradients[:, 0] * points[:, 1] - gradients[:, 1] * points[:, 0],
                template.values[seen],
                np.ones(len(points)),
            ]
        )
        residual = values_b - template.values[seen]
        along, _ = camera.line_of_sight_axes(points)
        shift = np.einsum("ni,ni->n", gradients, along) * camera.range_sigma(
            calibration, points, tilt_sigma_radians
        )
        model_variance = template.range_sigmas[seen] ** 2 + shift**2
        solved = _solve(jacobian, residual, model_variance)
        if solved is None:
            return None
        step, covariance = solved
        pose = pose @ Pose2(float(step[0]), float(step[1]), float(step[2]))
        reach = float(np.abs(points).max())
        moved = math.hypot(step[0], step[1]) + abs(step[2]) * reach
        if moved < _CONVERGED_PIXELS * metres_per_pixel:
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


def _make_template(
    view: View, level: int, calibration: Calibration, tilt_sigma_radians: float
) -> _Template | None:
    image, mask = _normalised(view.image, view.mask, level)
    scale = view.grid.metres_per_pixel * 2**level
    # Scharr's kernel sums to 32 over a span of two pixels' worth of slope.
    right = np.asarray(cv2.Scharr(image, cv2.CV_32F, 1, 0, scale=1.0 / (32.0 * scale)))
    up = np.asarray(cv2.Scharr(image, cv2.CV_32F, 0, 1, scale=-1.0 / (32.0 * scale)))
    strength = np.where(mask == 255, right * right + up * up, np.float32(0.0))
    usable = int(np.count_nonzero(strength))
    if usable < _LEAST_TEMPLATE_PIXELS:
        return None
    flat = strength.ravel()
    # The strongest gradients tell most; a sample of one in 16 tells well enough which those are.
    weaker = 1.0 - _MOST_TEMPLATE_PIXELS / flat.size
    least = float(np.quantile(flat[::16], weaker)) if weaker > 0 else 0.0
    chosen = np.flatnonzero(flat > least)
    rows, columns = np.unravel_index(chosen, strength.shape)
    metres_from_pixel = invert(_pixel_from_metres(view, level))
    points = apply_homography(metres_from_pixel, np.column_stack([columns, rows]))
    gradients = np.column_stack([right.ravel()[chosen], up.ravel()[chosen]]).astype(np.float64)
    along, _ = camera.line_of_sight_axes(points)
    range_sigmas = np.einsum("ni,ni->n", gradients, along) * camera.range_sigma(
        calibration, points, tilt_sigma_radians
    )
    values = image.ravel()[chosen].astype(np.float64)
    return _Template(points, values, gradients, range_sigmas)


def _shrink(
    image: NDArray[np.uint8], mask: NDArray[np.uint8], level: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Halve a view `level` times; only what was wholly seen stays 255 in the mask."""
    for _ in range(level):
        image = np.asarray(cv2.pyrDown(image), np.uint8)
        mask = np.asarray(cv2.pyrDown(mask), np.uint8)
    return image, mask


def _normalised(
    image: NDArray[np.uint8], mask: NDArray[np.uint8], level: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Shrink a view and take out its slow brightness, which belongs to lamp and lens."""
    small, small_mask = _shrink(image, mask, level)
    inside = (small_mask == 255).astype(np.float32)
    values = small.astype(np.float32) * inside
    size = (_HIGH_PASS_PIXELS, _HIGH_PASS_PIXELS)
    weight = np.asarray(cv2.blur(inside, size))
    mean = np.asarray(cv2.blur(values, size)) / np.maximum(weight, np.float32(1e-3))
    smooth = np.asarray(cv2.GaussianBlur((values - mean) * inside, (3, 3), 0))
    # The outermost ring's gradient would be that of the mask, not of the floor.
    eroded = cv2.erode(np.where(small_mask == 255, np.uint8(255), np.uint8(0)), np.ones((5, 5)))
    return smooth, np.asarray(eroded, np.uint8)


def _pixel_from_metres(view: View, level: int) -> NDArray[np.float64]:
    """(3, 3): robot frame to pixel of a view shrunk `level` times; pyrDown keeps even pixels."""
    factor = 0.5**level
    scaled: NDArray[np.float64] = np.diag([factor, factor, 1.0]) @ view.grid.pixel_from_metres
    return scaled


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
