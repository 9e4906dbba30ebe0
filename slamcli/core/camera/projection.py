"""Projection: floor points and floor rasters into the camera's own picture, lens included."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import distort_points, undistorted_bounds
from slamcli.core.geometry import Grid, Pose2, apply_homography, invert


def project_floor(calibration: Calibration, points: ArrayLike) -> tuple[Float64Array, BoolArray]:
    """Project floor points into the camera's own picture.

    Parameters
    ----------
    points : (N, 2) array, metres, robot frame

    Returns
    -------
    pixels : (N, 2) array
        Meaningful only where seen.
    seen : (N,) bool
        In front of the camera, inside the picture, within the calibration's range.
    """
    floor = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    depth = floor @ calibration.image_from_robot[2, :2] + calibration.image_from_robot[2, 2]
    in_front = depth > 0.0
    undistorted = np.full_like(floor, np.nan)
    undistorted[in_front] = apply_homography(calibration.image_from_robot, floor[in_front])
    low, high = undistorted_bounds(calibration)
    # Outside the undistorted picture the lens polynomial may fold back into it.
    in_bounds = in_front & np.all((undistorted >= low) & (undistorted <= high), axis=1)
    pixels = np.full_like(floor, np.nan)
    pixels[in_bounds] = distort_points(calibration, undistorted[in_bounds])
    width, height = calibration.image_size
    seen = in_bounds & (np.hypot(floor[:, 0], floor[:, 1]) <= calibration.max_range_metres)
    seen[seen] = np.all((pixels[seen] >= 0) & (pixels[seen] <= (width - 1, height - 1)), axis=1)
    return pixels, seen


@dataclass(frozen=True, slots=True, eq=False)
class SamplingMap:
    """Where in the camera's own picture each pixel of a floor raster is seen.

    Attributes
    ----------
    columns, rows : (h, w) float32
        In the camera's picture; meaningful only where the resolution is not 0.
    pixels_per_metre : (h, w) float32
        Of the raster given, at those places; 0 where the floor is not seen.
    """

    columns: Float32Array
    rows: Float32Array
    pixels_per_metre: Float32Array


def sampling_map(
    calibration: Calibration,
    pixels_per_metre: Float32Array,
    grid: Grid,
    robot_from_grid: Pose2,
) -> SamplingMap:
    """Project every pixel of a floor raster into the camera's own picture, lens included.

    Parameters
    ----------
    pixels_per_metre : (H, W) float32
        From `resolution_image`, or weights of the same zeros.
    grid : Grid
        In any frame on the floor (the robot's own, or the map).
    robot_from_grid : Pose2
        Where that frame lies for the robot.
    """
    robot_from_pixel = robot_from_grid.matrix @ grid.metres_from_pixel
    homography = calibration.image_from_robot @ robot_from_pixel
    normalised_from_pixel = invert(calibration.camera_matrix) @ homography
    # OpenCV's rectification maps take any plane homography for the "rotation" and apply the lens.
    # Floor behind the camera comes out above the horizon, where the resolution is 0.
    arguments = (invert(normalised_from_pixel), np.eye(3), (grid.width, grid.height))
    if calibration.distortion_model == "equidistant":
        columns, rows = cv2.fisheye.initUndistortRectifyMap(
            calibration.camera_matrix, calibration.distortion[:4], *arguments, cv2.CV_32FC1
        )
    else:
        columns, rows = cv2.initUndistortRectifyMap(
            calibration.camera_matrix, calibration.distortion, *arguments, cv2.CV_32FC1
        )
    sharp = np.asarray(
        cv2.remap(pixels_per_metre, columns, rows, cv2.INTER_LINEAR), dtype=np.float32
    )
    sharp[_out_of_range(calibration, robot_from_pixel, grid)] = 0.0
    if np.any(calibration.distortion):
        # Outside the undistorted picture the lens polynomial may fold back into it.
        sharp[_outside_undistorted(calibration, homography, grid)] = 0.0
    return SamplingMap(np.asarray(columns, np.float32), np.asarray(rows, np.float32), sharp)


def _out_of_range(
    calibration: Calibration, robot_from_pixel: Float64Array, grid: Grid
) -> BoolArray:
    """Return (h, w): whether a raster's pixel lies beyond the range, by its place on the floor."""
    column = np.arange(grid.width, dtype=np.float32)
    row = np.arange(grid.height, dtype=np.float32)
    matrix = robot_from_pixel.astype(np.float32)
    # The squared distance of R p + t is |p|^2 s^2 + 2 t . R p + |t|^2: a sum of row and column.
    scale, offset = grid.metres_per_pixel**2, matrix[:2, 2]
    along = scale * column**2 + 2 * float(offset @ matrix[:2, 0]) * column
    down = scale * row**2 + 2 * float(offset @ matrix[:2, 1]) * row
    limit = np.float32(calibration.max_range_metres**2 - float(offset @ offset))
    beyond: BoolArray = along[None, :] > (limit - down)[:, None]
    return beyond


def _outside_undistorted(
    calibration: Calibration, homography: Float64Array, grid: Grid
) -> BoolArray:
    """Return (h, w): whether a raster's pixel lies outside the undistorted picture."""
    column = np.arange(grid.width, dtype=np.float32)[None, :]
    row = np.arange(grid.height, dtype=np.float32)[:, None]
    x, y, depth = (h[0] * column + h[1] * row + h[2] for h in homography.astype(np.float32))
    low, high = undistorted_bounds(calibration).astype(np.float32)
    inside = (depth > 0) & (x >= low[0] * depth) & (x <= high[0] * depth)
    inside &= (y >= low[1] * depth) & (y <= high[1] * depth)
    outside: BoolArray = ~inside
    return outside
