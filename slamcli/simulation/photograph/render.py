"""The renderer: what an ideal lens throws on the sensor, one small tile of the picture at a time.

Each pixel is the mean of several rays, more along the line of sight, where a pixel covers most
floor. A tile of the picture reads its floor from the pyramid level (mip map) that matches what is
left for a ray to cover: one homography and one resampling a tile.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Grid, Pose2
from slamcli.simulation.floors import MAX_LEVEL, Texture
from slamcli.simulation.photograph.decals import draw_decals
from slamcli.simulation.photograph.distance import (
    MARGIN_PIXELS,
    WALL_HEIGHTS,
    draw_distance,
    scaled,
)
from slamcli.simulation.photograph.tiles import Tile, carry, make_tiles, rim
from slamcli.simulation.photograph.world import World

# Half the rays down are enough where a pixel covers a piece of floor at most this many times as
# long as wide.
_MAX_ELONGATION_FOR_HALF_RAYS = 1.6
# One level serves a tile whose rays cover floor that differs by a factor of two at most: their
# share falls with the homogeneous scale's power of 3/2.
_MAX_SCALE_RATIO = 2.0 ** (2.0 / 3.0)


class Shutter(NamedTuple):
    """Where the robot is as the first and as the last row of a picture is exposed.

    Attributes
    ----------
    first, last : Pose2
        ``world_from_robot``; the same for a global shutter.
    """

    first: Pose2
    last: Pose2


class _View(NamedTuple):
    """Where the camera stands as it takes a picture.

    Attributes
    ----------
    calibration : Calibration
    pixel_area : float
        Square metres of floor to a pixel whose homogeneous scale on the floor is 1; it falls with
        the scale's third power.
    shutter : Shutter
    """

    calibration: Calibration
    pixel_area: float
    shutter: Shutter

    def pose_at(self, share: float) -> Pose2:
        """Return world_from_robot at a share of the picture's height."""
        first, last = self.shutter
        if first == last:
            return first
        motion = first.inverse() @ last
        return first @ Pose2(share * motion.x, share * motion.y, share * motion.theta)


class Renderer:
    """Renders a world as one camera's lens shows it.

    Parameters
    ----------
    world : World
    calibration : Calibration
        Of the lens and the picture's size; where the camera stands is given for each picture.
    """

    def __init__(self, world: World, calibration: Calibration) -> None:
        self.world = world
        self.image_size = calibration.image_size
        self._tiles = make_tiles(calibration)

    def render(self, shutter: Shutter, calibration: Calibration) -> Float32Array:
        """Return (H, W, 3) float32 BGR of one instant, or of one roll of the shutter.

        Parameters
        ----------
        shutter : Shutter
        calibration : Calibration
            Where the camera stands at this moment: a rocking robot tilts and lifts it.
        """
        width, height = self.image_size
        area = abs(float(np.linalg.det(calibration.robot_from_image)))
        view = _View(calibration, area, shutter)
        picture = np.empty((height, width, 3), np.float32)
        for tile in self._tiles:
            self._draw(tile, view, picture)
        return picture

    def _draw(self, tile: Tile, view: _View, picture: Float32Array) -> None:
        """Draw a tile into the picture, by halves where it reaches from near to far."""
        height = self.image_size[1]
        poses = [view.pose_at(row / height) for row in (tile.rows.start, tile.rows.stop)]
        around = rim(tile.rays)
        scales = around @ view.calibration.robot_from_image[2, :2]
        scales += view.calibration.robot_from_image[2, 2]
        far, near = float(scales.min()), float(scales.max())
        reach = self._floor_reach(around, poses, view) if far > 0.0 else None
        seen: Texture | Float32Array
        if reach is None:
            area = view.pixel_area * tile.pixels_per_ray(tile.rays)
            seen = draw_distance(self.world, tile.rays, poses[0], view.calibration, area)
        elif near > _MAX_SCALE_RATIO * far and tile.halves():
            for half in tile.halves():
                self._draw(half, view, picture)
            return
        else:
            elongation = math.hypot(1.0, reach / view.calibration.height_metres)
            halved = elongation < _MAX_ELONGATION_FOR_HALF_RAYS
            rays = tile.half_rays if halved else tile.rays
            area = view.pixel_area * tile.pixels_per_ray(rays)
            seen = self._floor(rays, poses, view, math.sqrt(area / (far * near) ** 1.5))
        small: Texture | Float32Array = cv2.resize(seen, tile.size, interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        picture[tile.rows, tile.columns] = scaled(small)

    def _floor_reach(self, around: Float64Array, poses: list[Pose2], view: _View) -> float | None:
        """Return metres from the robot to the farthest floor; None where not all is floor."""
        robot = carry(around, view.calibration.robot_from_image)
        reach = float(np.hypot(robot[:, 0], robot[:, 1]).max())
        room = self.world.room
        if room is None:
            return reach if reach < 0.98 * WALL_HEIGHTS * view.calibration.height_metres else None
        away = max(float(np.abs(pose.apply(robot) - room.centre).max()) for pose in poses)
        return reach if away < 0.49 * room.side_metres else None

    def _floor(
        self, rays: Float32Array, poses: list[Pose2], view: _View, sampling: float
    ) -> Texture | Float32Array:
        """Read the floor at a tile's rays, each of which covers `sampling` metres of it."""
        floor = self.world.floor
        level = min(round(math.log2(max(sampling / floor.metres_per_pixel, 1.0))), MAX_LEVEL)
        scale = floor.metres_per_pixel * 2.0**level
        seen = [pose.matrix @ view.calibration.robot_from_image for pose in poses]
        rolling = poses[0] != poses[1]
        around = rim(rays)
        reached = np.vstack([carry(around, matrix) for matrix in seen[: 1 + rolling]])
        margin = MARGIN_PIXELS * scale
        grid = Grid.covering([reached.min(axis=0) - margin, reached.max(axis=0) + margin], scale)
        places = cv2.perspectiveTransform(rays, grid.pixel_from_metres @ seen[0])
        if rolling:
            last = cv2.perspectiveTransform(rays, grid.pixel_from_metres @ seen[1])
            share = ((np.arange(len(rays)) + 0.5) / len(rays)).astype(np.float32)
            places += share[:, None, None] * (last - places)
        read: Texture = cv2.remap(floor.region(grid), places, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
        # 16 bits are fine enough for the mean of a pixel's rays; 8 are not.
        if read.dtype == np.uint16 and not self.world.decals:
            return read
        picture = scaled(read)
        draw_decals(self.world.decals, rays, seen[0], picture)
        return picture
