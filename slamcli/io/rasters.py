"""Pictures that know where they lie: a PNG with its world file and its Nav2 map description."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamcli.io.files import write_image, write_text

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from slamcli.core.geometry import Grid


def write_georeferenced_png(
    path: Path, image: NDArray[np.uint8], mask: NDArray[np.uint8], grid: Grid
) -> None:
    """Write BGR pixels, transparent where the mask is 0, with an ESRI world file (.pgw) beside.

    The world file holds the affine transform from pixel to metres, its origin at the centre of
    the upper left pixel.
    """
    write_image(path, np.dstack([image, mask]))
    transform = grid.metres_from_pixel
    values = (
        transform[0, 0],
        transform[1, 0],
        transform[0, 1],
        transform[1, 1],
        transform[0, 2],
        transform[1, 2],
    )
    write_text(path.with_suffix(".pgw"), "".join(f"{value:.10f}\n" for value in values))


def write_nav2_map(path: Path, picture_name: str, grid: Grid, unit: str) -> None:
    """Write the map_server description (Nav2 / ROS map_server YAML) of a picture beside it."""
    length = {"m": "metres", "px": "pixels"}[unit]
    write_text(
        path,
        f"# Lengths in {length}; origin: x, y of the lower left pixel's corner, and yaw (rad).\n"
        f"image: {picture_name}\n"
        f"mode: trinary\n"
        f"resolution: {grid.metres_per_pixel:.10g}\n"
        f"origin: [{grid.x_min:.10g}, {grid.y_min:.10g}, 0.0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        "free_thresh: 0.196\n",
    )
