"""Resolution: how much floor a pixel of the camera covers, and how a tilt shifts a floor point."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import undistorted_coordinates
from slamcli.core.geometry import apply_homography

# Pixels this much farther than the range are kept until their exact place is known.
_RANGE_MARGIN = 1.05
_BAND_PIXELS = 2**22


def floor_sampling(calibration: Calibration, points: ArrayLike) -> Float64Array:
    """Return how many metres of floor one pixel covers at (N, 2) points in the robot frame.

    Returns
    -------
    (N, 2) array, metres per pixel: along the line of sight on the floor, and across it; from the
    Jacobian of the floor homography (lens distortion is left out: it changes this by little).
    """
    floor = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    homography = calibration.image_from_robot
    denominator = floor @ homography[2, :2] + homography[2, 2]
    pixels = apply_homography(homography, floor)
    jacobian = (
        homography[None, :2, :2] - pixels[:, :, None] * homography[None, 2:, :2]
    ) / denominator[:, None, None]
    along, across = line_of_sight_axes(floor)
    pixels_per_metre = np.stack(
        [
            np.linalg.norm(np.einsum("nij,nj->ni", jacobian, along), axis=1),
            np.linalg.norm(np.einsum("nij,nj->ni", jacobian, across), axis=1),
        ],
        axis=1,
    )
    sampling: Float64Array = 1.0 / pixels_per_metre
    return sampling


def range_sigma(
    calibration: Calibration, points: ArrayLike, tilt_sigma_radians: float
) -> Float64Array:
    """Return (N,) metres by which floor points shift along the line of sight when the camera tilts.

    A point at distance d, seen from height h under the angle atan(h / d), moves by
    (d^2 + h^2) / h for a radian. Zero where the height is not known.
    """
    floor = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if not math.isfinite(calibration.height_metres):
        return np.zeros(len(floor))
    squared = np.einsum("ni,ni->n", floor, floor)
    height = calibration.height_metres
    sigma: Float64Array = (squared + height**2) / height * tilt_sigma_radians
    return sigma


def line_of_sight_axes(
    points: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return the unit vectors on the floor along and across the line of sight, each (N, 2)."""
    distance = np.hypot(points[:, 0], points[:, 1])
    straight_below = distance < 1e-12
    along = np.where(
        straight_below[:, None],
        np.array([1.0, 0.0]),
        points / np.where(straight_below, 1.0, distance)[:, None],
    )
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return along, across


@lru_cache(maxsize=2)
def resolution_image(calibration: Calibration) -> Float32Array:
    """Return (H, W): how many pixels a metre of floor spans at each pixel of the camera's picture.

    The geometric mean of both directions; 0 where the pixel shows no floor within range, or just
    beyond it: `projection.sampling_map`, which knows each pixel's place on the floor, applies the
    exact limit. Read-only, as it is computed once for each calibration.
    """
    width, height = calibration.image_size
    pixels_per_metre = np.zeros((height, width), dtype=np.float32)
    # In bands: the coordinates of all pixels of a large picture would take ten times its memory.
    step = max(1, _BAND_PIXELS // width)
    for first in range(0, height, step):
        band = pixels_per_metre[first : first + step]
        _fill_band(calibration, np.arange(first, first + len(band), dtype=np.float32), band)
    # All callers are given the same array.
    pixels_per_metre.setflags(write=False)
    return pixels_per_metre


def _fill_band(calibration: Calibration, rows_read: Float32Array, band: Float32Array) -> None:
    """Fill some rows of a resolution image, which are all zero."""
    # A row and a column, for numpy to spread: the products are then a few, not all pixels'.
    columns, rows = np.arange(band.shape[1], dtype=np.float32)[None], rows_read[:, None]
    if np.any(calibration.distortion):
        columns, rows = undistorted_coordinates(calibration, *np.broadcast_arrays(columns, rows))
    inverse = calibration.robot_from_image.astype(np.float32)
    x, y, w = (row[0] * columns + row[1] * rows + row[2] for row in inverse)
    reach = np.float32(_RANGE_MARGIN * calibration.max_range_metres)
    seen = (w > 0) & (x * x + y * y <= (reach * w) ** 2)
    # A pixel covers |det H| / w^3 of floor, the Jacobian determinant of the plane map x -> Hx / w.
    determinant = abs(float(np.linalg.det(calibration.robot_from_image)))
    np.sqrt(w**3 / np.float32(determinant), out=band, where=seen)
