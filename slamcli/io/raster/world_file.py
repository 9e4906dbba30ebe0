"""Georeferenced pictures: PNG with a world file, and Nav2 maps."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.calibration import Unit
from slamcli.core.geometry import Grid, Pose2
from slamcli.io.files import write_bytes, write_text
from slamcli.io.raster import png

# The values that Nav2's map_saver writes for them.
FREE_GRAY, OCCUPIED_GRAY, UNKNOWN_GRAY = 254, 0, 205
_UPRIGHT = Pose2()


def write_georeferenced_png(path: Path, image: UInt8Array, mask: UInt8Array, grid: Grid) -> None:
    """Write BGR pixels, transparent where the mask is 0, with an ESRI world file (.pgw) beside.

    The world file is the affine transform from pixel to metres, its origin at the centre of the
    upper left pixel.
    """
    png.write_png(path, grid.width, grid.height, [png.compress(image, mask)])
    write_world_file(path.with_suffix(".pgw"), grid)


def transparent(image: UInt8Array, mask: UInt8Array) -> UInt8Array:
    """Return (h, w, 4) BGRA of BGR pixels and a mask."""
    pixels = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2BGRA), np.uint8)
    return np.asarray(cv2.insertChannel(mask, pixels, 3), np.uint8)


def write_world_file(path: Path, grid: Grid, map_from_grid: Pose2 = _UPRIGHT) -> None:
    """Write an ESRI world file for a picture whose grid may be turned in the map."""
    transform = map_from_grid.matrix @ grid.metres_from_pixel
    values = (*transform[:2, 0], *transform[:2, 1], *transform[:2, 2])
    write_text(path, "".join(f"{value:.10f}\n" for value in values))


def write_nav2_map(
    path: Path,
    picture_name: str,
    grid: Grid,
    unit: Unit,
    map_from_grid: Pose2 = _UPRIGHT,
    *,
    occupancy: bool = True,
) -> None:
    """Write the map_server description (Nav2 / ROS map_server YAML) of a picture beside it.

    Parameters
    ----------
    occupancy : bool
        Whether its gray levels say what is occupied. A picture of the floor does not: thresholds
        that no level passes make map_server read all of it as unknown.
    """
    occupied, free = (0.65, 0.196) if occupancy else (1.0, 0.0)
    note = "" if occupancy else "# A picture, no occupancy: all of it is unknown to map_server.\n"
    length = {"m": "metres", "px": "pixels", "h": "heights of the camera"}[unit]
    x, y = map_from_grid.apply([(grid.x_min, grid.y_min)])[0]
    write_text(
        path,
        f"# Lengths in {length}; origin: x, y of the lower left pixel's corner, and yaw (rad).\n"
        f"{note}"
        f"image: {picture_name}\n"
        f"mode: trinary\n"
        f"resolution: {grid.metres_per_pixel:.10g}\n"
        f"origin: [{x:.10g}, {y:.10g}, {_plain(map_from_grid.theta)}]\n"
        "negate: 0\n"
        f"occupied_thresh: {occupied}\n"
        f"free_thresh: {free}\n",
    )


def write_pgm(path: Path, gray: UInt8Array) -> None:
    """Write (h, w) gray pixels as a binary PGM (P5)."""
    header = f"P5\n{gray.shape[1]} {gray.shape[0]}\n255\n".encode()
    write_bytes(path, header + np.ascontiguousarray(gray).tobytes())


def _plain(angle_radians: float) -> str:
    return "0.0" if math.isclose(angle_radians, 0.0, abs_tol=1e-12) else f"{angle_radians:.10g}"
