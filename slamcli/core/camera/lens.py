"""The lens: pixels of the camera's own picture to undistorted pixels, and back.

Distortion polynomials as in ROS camera_info / OpenCV: ``plumb_bob`` and ``rational_polynomial`` are
Brown-Conrady, ``equidistant`` is Kannala-Brandt (fisheye).
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.calibration import CACHED_CALIBRATIONS, Calibration, Intrinsics
from slamcli.core.geometry import apply_homography, invert

# A sampling of the picture's border fine enough that its outline on the floor is smooth.
_OUTLINE_POINTS_PER_SIDE = 48
# Lens distortion is so smooth that a point in this many pixels each way is enough to interpolate
# between [guarded by tests/core/camera].
_LATTICE_PIXELS = 4

Lens = Calibration | Intrinsics


def image_centre(image_size: tuple[int, int]) -> tuple[float, float]:
    """Return the (column, row) of a picture's middle, where a pixel's centre is a whole number."""
    width, height = image_size
    return (width - 1) / 2, (height - 1) / 2


def image_outline(image_size: tuple[int, int]) -> Float64Array:
    """Return (4 n, 2) pixels around the picture's border, clockwise from the upper left."""
    width, height = image_size
    step = np.linspace(0.0, 1.0, _OUTLINE_POINTS_PER_SIDE, endpoint=False)
    zero, one = np.zeros_like(step), np.ones_like(step)
    unit = np.concatenate(
        [
            np.column_stack([step, zero]),
            np.column_stack([one, step]),
            np.column_stack([1.0 - step, one]),
            np.column_stack([zero, 1.0 - step]),
        ]
    )
    outline: Float64Array = unit * (width - 1, height - 1)
    return outline


def undistort_points(calibration: Lens, pixels: ArrayLike) -> Float64Array:
    """Map (N, 2) pixels of the camera's own picture to (N, 2) undistorted pixels."""
    points = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0 or not np.any(calibration.distortion):
        return points.copy()
    matrix, distortion = calibration.camera_matrix, calibration.distortion
    # OpenCV's iteration stops early by default; a camera model has to invert to well below a pixel.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    if calibration.distortion_model == "equidistant":
        mapped = cv2.fisheye.undistortPoints(
            points[:, None], matrix, distortion[:4], P=matrix, criteria=criteria
        )
    else:
        mapped = cv2.undistortPoints(
            points[:, None], matrix, distortion, P=matrix, criteria=criteria
        )
    return np.asarray(mapped, dtype=np.float64).reshape(-1, 2)


def distort_points(calibration: Lens, pixels: ArrayLike) -> Float64Array:
    """Map (N, 2) undistorted pixels to (N, 2) pixels of the camera's own picture."""
    points = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0 or not np.any(calibration.distortion):
        return points.copy()
    matrix, distortion = calibration.camera_matrix, calibration.distortion
    normalised = apply_homography(invert(matrix), points)
    if calibration.distortion_model == "equidistant":
        mapped = cv2.fisheye.distortPoints(normalised[:, None], matrix, distortion[:4])
    else:
        rays = np.column_stack([normalised, np.ones(len(normalised))])
        mapped, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(mapped, dtype=np.float64).reshape(-1, 2)


@lru_cache(maxsize=CACHED_CALIBRATIONS)
def undistorted_bounds(calibration: Calibration) -> Float64Array:
    """Return (2, 2): lowest and highest undistorted pixel that the picture's border maps to.

    Read-only, as it is computed once for each calibration.
    """
    outline = undistort_points(calibration, image_outline(calibration.image_size))
    margin = 1.0
    bounds = np.array([outline.min(axis=0) - margin, outline.max(axis=0) + margin])
    bounds.setflags(write=False)
    return bounds


def undistorted_coordinates(
    calibration: Calibration, columns: Float32Array, rows: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return the undistorted columns and rows, (h, w) each, of pixels of the camera's picture.

    Exact on a lattice of every fourth pixel, interpolated between its points.
    """
    width, height = calibration.image_size
    start = -_LATTICE_PIXELS
    lattice_columns, lattice_rows = np.meshgrid(
        np.arange(start, width + _LATTICE_PIXELS, _LATTICE_PIXELS, dtype=np.float64),
        np.arange(start, height + _LATTICE_PIXELS, _LATTICE_PIXELS, dtype=np.float64),
    )
    lattice = np.column_stack([lattice_columns.ravel(), lattice_rows.ravel()])
    undistorted = undistort_points(calibration, lattice).astype(np.float32)
    field = undistorted.reshape(*lattice_columns.shape, 2)
    scale = np.float32(1.0 / _LATTICE_PIXELS)
    interpolated = cv2.remap(
        field, (columns - start) * scale, (rows - start) * scale, cv2.INTER_LINEAR
    )
    both = np.asarray(interpolated, dtype=np.float32)
    return both[..., 0], both[..., 1]
