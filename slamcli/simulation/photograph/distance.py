"""Tiles that show the horizon, walls, or floor too far away: each ray on its own."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.light import light_of_gray
from slamcli.simulation.floors import MAX_LEVEL, Floor, Texture
from slamcli.simulation.photograph.decals import draw_decals
from slamcli.simulation.photograph.world import Room, World

# Floor beyond this many camera heights is a wall; nobody maps that far.
WALL_HEIGHTS = 14.0
MARGIN_PIXELS = 2
_WALL_BGR = (150.0, 162.0, 170.0)
_CEILING_METRES = 2.6


def draw_distance(
    world: World,
    rays: Float32Array,
    world_from_robot: Pose2,
    calibration: Calibration,
    ray_area: float,
) -> Float32Array:
    """Return (h, w, 3) float32 BGR at (h, w, 2) undistorted pixels.

    Parameters
    ----------
    ray_area : float
        Square metres of floor to a ray whose homogeneous scale on the floor is 1.
    """
    columns, rows = rays[..., 0], rays[..., 1]
    inverse = calibration.robot_from_image.astype(np.float32)
    x, y, w = (row[0] * columns + row[1] * rows + row[2] for row in inverse)
    room = world.room
    if room is None:
        far = np.float32(calibration.height_metres * WALL_HEIGHTS)
        on_floor = (w > 0) & (x * x + y * y <= (far * w) ** 2)
    else:
        reach, wall_x = _to_walls(room, world_from_robot, x, y)
        on_floor = w * reach > 1.0
    in_light = world.floor.in_light
    plain = [light_of_gray(gray) if in_light else gray for gray in _WALL_BGR]
    walls = np.empty((*w.shape, 3), np.float32)
    walls[:] = np.array(plain, np.float32)
    if room is not None:
        up = np.float32(calibration.height_metres) * (1.0 - reach * w)
        finer = reach * np.hypot(x, y) / np.float32(2.0 * calibration.camera_matrix[0, 0])
        _read(room.wall, wall_x, up, finer, ~on_floor & (up < _CEILING_METRES), walls)
    floor = walls.copy()
    safe = np.where(on_floor, w, np.float32(1.0))
    m = world_from_robot.matrix.astype(np.float32)
    floor_x, floor_y = x / safe, y / safe
    world_x = m[0, 0] * floor_x + m[0, 1] * floor_y + m[0, 2]
    world_y = m[1, 0] * floor_x + m[1, 1] * floor_y + m[1, 2]
    _read(world.floor, world_x, world_y, np.sqrt(ray_area / safe**3), on_floor, floor)
    draw_decals(world.decals, rays, world_from_robot.matrix @ calibration.robot_from_image, floor)
    return np.where(on_floor[..., None], floor, walls)


def scaled(texture: Texture | Float32Array) -> Float32Array:
    """Return values read from a texture on the scale on which white is 255."""
    scale = 255.0 / 65535.0 if texture.dtype == np.uint16 else 1.0
    return np.multiply(texture, np.float32(scale), dtype=np.float32)


def _read(
    floor: Floor,
    world_x: Float32Array,
    world_y: Float32Array,
    sampling: Float32Array,
    wanted: BoolArray,
    picture: Float32Array,
) -> None:
    """Fill in the wanted rays of a picture from the texture, each from its own level."""
    if not wanted.any():
        return
    finest = floor.metres_per_pixel
    level = np.clip(np.round(np.log2(np.maximum(sampling / finest, 1.0))), 0, MAX_LEVEL)
    for number in np.unique(level[wanted]):
        chosen = wanted & (level == number)
        scale = finest * 2 ** int(number)
        margin = MARGIN_PIXELS * scale
        corners = np.array(
            [
                [world_x[chosen].min() - margin, world_y[chosen].min() - margin],
                [world_x[chosen].max() + margin, world_y[chosen].max() + margin],
            ]
        )
        grid = Grid.covering(corners, scale)
        to_pixel = grid.pixel_from_metres
        columns = (to_pixel[0, 0] * world_x + to_pixel[0, 2]).astype(np.float32)
        rows = (to_pixel[1, 1] * world_y + to_pixel[1, 2]).astype(np.float32)
        read: Texture = cv2.remap(floor.region(grid), columns, rows, cv2.INTER_LINEAR)  # type: ignore[assignment]
        picture[chosen] = scaled(read[chosen])


def _to_walls(
    room: Room, world_from_robot: Pose2, x: Float32Array, y: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return how many times (x, y) in the robot's axes reach a wall, and where along the walls."""
    cosine, sine = math.cos(world_from_robot.theta), math.sin(world_from_robot.theta)
    ahead, left = cosine * x - sine * y, sine * x + cosine * y
    start_x, start_y = world_from_robot.x - room.centre[0], world_from_robot.y - room.centre[1]
    half = room.side_metres / 2
    with np.errstate(divide="ignore"):
        to_x = np.maximum((half - start_x) / ahead, (-half - start_x) / ahead)
        to_y = np.maximum((half - start_y) / left, (-half - start_y) / left)
    reach = np.minimum(to_x, to_y)
    met_x, met_y = start_x + reach * ahead, start_y + reach * left
    side = np.where(to_x < to_y, np.where(ahead > 0, 0, 2), np.where(left > 0, 1, 3))
    along = np.choose(side, [met_y, -met_x, -met_y, met_x])
    return reach.astype(np.float32), (side * room.side_metres + along).astype(np.float32)
