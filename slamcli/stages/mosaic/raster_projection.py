"""Projection of a raster of the map into one camera image: homography, lens, resolution, weight."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import distort_points, undistorted_bounds
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.stages.mosaic.source_image import SourceImage

# Lens distortion is so smooth that interpolation between lattice points this far apart is exact to
# a hundredth of a pixel.
_LATTICE_PIXELS = 8
_LARGE_PIXELS = 128
_OUT_OF_SIGHT = -1.0e4
_MIN_DEPTH = 1.0e-6


@dataclass(frozen=True, slots=True, eq=False)
class RasterProjection:
    """One camera over one raster.

    Attributes
    ----------
    image_from_pixel : (3, 3) float64
        From the raster to the undistorted image.
    lens : ((h, w) float32, (h, w) float32) or None
        Columns and rows in the distorted image; None without distortion.
    pixels_per_metre, weight : (h, w) float32
        The resolution, and that with all that is not usable at 0.
    """

    image_from_pixel: Float64Array
    lens: tuple[Float32Array, Float32Array] | None
    pixels_per_metre: Float32Array
    weight: Float32Array


def project_raster(
    source: SourceImage, calibration: Calibration, map_from_robot: Pose2, grid: Grid
) -> RasterProjection:
    """Return where each pixel of a raster lies in a frame's image, and how well it is seen there.

    Parameters
    ----------
    calibration : Calibration
        The frame's own: its tilt and height may differ from the others'.
    """
    robot_from_pixel = map_from_robot.inverse().matrix @ grid.metres_from_pixel
    homography = calibration.image_from_robot @ robot_from_pixel
    lens = None
    if np.any(calibration.distortion):
        lens = _lens_map(calibration, homography, grid)
        usable = cv2.remap(source.usable, *lens, cv2.INTER_LINEAR)
    else:
        usable = cv2.warpPerspective(
            source.usable,
            homography,
            (grid.width, grid.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
    pixels_per_metre = _resolution(calibration, robot_from_pixel, grid)
    scaled = cv2.multiply(usable, pixels_per_metre, scale=1.0 / 255.0, dtype=cv2.CV_32F)
    weight = np.asarray(scaled, np.float32)
    corners = map_from_robot.inverse().apply(grid.corners)
    if np.hypot(*corners.T).max() > calibration.max_range_metres:
        weight[_out_of_range(calibration, robot_from_pixel, grid)] = 0.0
    return RasterProjection(homography, lens, pixels_per_metre, weight)


def _out_of_range(
    calibration: Calibration, robot_from_pixel: Float64Array, grid: Grid
) -> BoolArray:
    """Return (h, w): whether a pixel lies beyond the range.

    The squared distance of R p + t is |p|^2 s^2 + 2 t . R p + |t|^2: a sum of row and column.
    """
    offset = robot_from_pixel[:2, 2]
    column, row = np.arange(grid.width), np.arange(grid.height)
    scale = grid.metres_per_pixel**2
    along = scale * column**2 + 2 * float(offset @ robot_from_pixel[:2, 0]) * column
    down = scale * row**2 + 2 * float(offset @ robot_from_pixel[:2, 1]) * row
    limit = calibration.max_range_metres**2 - float(offset @ offset)
    return np.greater(along.astype(np.float32)[None, :], (limit - down).astype(np.float32)[:, None])


def _resolution(
    calibration: Calibration, robot_from_pixel: Float64Array, grid: Grid
) -> Float32Array:
    """Return (h, w) pixels per metre; meaningless behind the camera, which no image shows.

    A plane homography H enlarges areas by det H / w^3, and w is linear over the floor.
    """
    from_robot = calibration.image_from_robot
    row = from_robot[2] @ robot_from_pixel / abs(float(np.linalg.det(from_robot))) ** (1.0 / 3.0)
    column = (row[0] * np.arange(grid.width)).astype(np.float32)
    line = (row[1] * np.arange(grid.height) + row[2]).astype(np.float32)
    depth = column[None, :] + line[:, None]
    np.maximum(depth, np.float32(_MIN_DEPTH), out=depth)
    return np.asarray(cv2.pow(depth, -1.5), np.float32)


def _lens_map(
    calibration: Calibration, homography: Float64Array, grid: Grid
) -> tuple[Float32Array, Float32Array]:
    """Return the column and the row of each pixel of a raster in the camera's distorted image.

    Exact on a lattice, interpolated between its points.
    """
    # A power of two: OpenCV interpolates in steps of 1/32.
    step = _LATTICE_PIXELS if min(grid.width, grid.height) >= _LARGE_PIXELS else 2
    across, down = -(-grid.width // step) + 1, -(-grid.height // step) + 1
    columns, rows = np.meshgrid(
        step * np.arange(across, dtype=np.float64), step * np.arange(down, dtype=np.float64)
    )
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    undistorted = apply_homography(homography, pixels)
    depth = pixels @ homography[2, :2] + homography[2, 2]
    low, high = undistorted_bounds(calibration)
    # Far outside the image the lens polynomial folds back into it; near its border it does not.
    slack = 0.05 * (high - low)
    outside = (depth <= 0) | ~np.all(
        (undistorted >= low - slack) & (undistorted <= high + slack), axis=1
    )
    undistorted[outside] = low
    distorted = distort_points(calibration, undistorted)
    distorted[outside] = _OUT_OF_SIGHT
    lattice = distorted.reshape(down, across, 2).astype(np.float32)
    matrix = np.array([[1.0 / step, 0.0, 0.0], [0.0, 1.0 / step, 0.0]])
    both = np.asarray(
        cv2.warpAffine(
            lattice,
            matrix,
            (grid.width, grid.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.float32,
    )
    return np.ascontiguousarray(both[..., 0]), np.ascontiguousarray(both[..., 1])
