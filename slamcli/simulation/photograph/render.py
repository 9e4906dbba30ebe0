"""What a camera over a floor sees, ray by ray: perspective, lens, walls, boxes, and no aliasing.

Each pixel is the mean of several rays, more along the line of sight, where a pixel covers most
floor; each ray reads the floor from the pyramid level that matches the area it has to cover.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import undistorted_coordinates
from slamcli.core.geometry import Grid, Pose2
from slamcli.simulation.floors import Floor
from slamcli.simulation.photograph.boxes import draw_boxes
from slamcli.simulation.photograph.world import Room, World

_RAYS_ACROSS, _RAYS_DOWN = 2, 4
# Floor beyond this many camera heights is drawn as a plain wall; nobody maps that far.
_WALL_HEIGHTS = 14.0
_WALL_BGR = (150.0, 162.0, 170.0)
_MAX_LEVEL = 5
_CEILING_METRES = 2.6


class Photographer:
    """Renderer of images of a world, by one camera.

    Parameters
    ----------
    world : World
    calibration : Calibration
        The true one.
    """

    def __init__(self, world: World, calibration: Calibration) -> None:
        self.world = world
        self.calibration = calibration
        width, height = calibration.image_size
        # Rays lie evenly inside each pixel, the pixel's centre at a whole number.
        across = Grid(0.0, 0.0, 1.0 / _RAYS_ACROSS, width * _RAYS_ACROSS, 1)
        down = Grid(0.0, 0.0, 1.0 / _RAYS_DOWN, 1, height * _RAYS_DOWN)
        pixels = Grid(0.0, 0.0, 1.0, width, height).pixel_from_metres
        columns = _along(pixels[0], across.metres_from_pixel[0], across.width, axis=0)
        rows = _along(pixels[1], down.metres_from_pixel[1], down.height, axis=1)
        grid_columns, grid_rows = np.meshgrid(columns, rows)
        if np.any(calibration.distortion):
            grid_columns, grid_rows = undistorted_coordinates(calibration, grid_columns, grid_rows)
        self._columns, self._rows = grid_columns, grid_rows

    def expose(
        self, world_from_robot: Pose2, calibration: Calibration, stamp: float
    ) -> Float32Array:
        """Return (H, W, 3) float32 BGR of one instant, without noise."""
        inverse = calibration.robot_from_image.astype(np.float32)
        x, y, w = (row[0] * self._columns + row[1] * self._rows + row[2] for row in inverse)
        room = self.world.room
        if room is None:
            far = calibration.height_metres * _WALL_HEIGHTS
            on_floor = (w > 0) & (x * x + y * y <= (np.float32(far) * w) ** 2)
        else:
            reach, wall_x = _to_walls(room, world_from_robot, x, y)
            on_floor = w * reach > 1.0
        safe = np.where(on_floor, w, np.float32(1.0))
        floor = np.dstack([x / safe, y / safe])
        determinant = abs(float(np.linalg.det(calibration.robot_from_image)))
        sampling = np.sqrt(determinant / (_RAYS_ACROSS * _RAYS_DOWN) / safe**3)
        matrix = world_from_robot.matrix.astype(np.float32)
        world_x = matrix[0, 0] * floor[..., 0] + matrix[0, 1] * floor[..., 1] + matrix[0, 2]
        world_y = matrix[1, 0] * floor[..., 0] + matrix[1, 1] * floor[..., 1] + matrix[1, 2]
        rays = np.empty((*world_x.shape, 3), np.float32)
        rays[:] = np.array(_WALL_BGR, np.float32)
        _read(self.world.floor, world_x, world_y, sampling, on_floor, rays)
        if room is not None:
            up = np.float32(calibration.height_metres) * (1.0 - reach * w)
            finer = reach * np.hypot(x, y) / calibration.camera_matrix[0, 0] / 2.0
            _read(room.wall, wall_x, up, finer, ~on_floor & (up < _CEILING_METRES), rays)
        for decal in self.world.decals:
            rays[on_floor & _inside(decal.corners, world_x, world_y)] = decal.gray
        width, height = calibration.image_size
        small = cv2.resize(rays, (width, height), interpolation=cv2.INTER_AREA)
        image = np.asarray(small, np.float32)
        draw_boxes(image, self.world.boxes, world_from_robot, calibration, stamp)
        return image


def _read(
    floor: Floor,
    world_x: Float32Array,
    world_y: Float32Array,
    sampling: Float32Array,
    wanted: BoolArray,
    image: Float32Array,
) -> None:
    """Fill in the wanted rays of an image from the texture, each from its own level."""
    if not wanted.any():
        return
    finest = floor.metres_per_pixel
    level = np.clip(np.round(np.log2(np.maximum(sampling / finest, 1.0))), 0, _MAX_LEVEL)
    for number in np.unique(level[wanted]):
        inside = wanted & (level == number)
        rows = np.flatnonzero(inside.any(axis=1))
        band = slice(int(rows[0]), int(rows[-1]) + 1)
        chosen = inside[band]
        x, y = world_x[band], world_y[band]
        scale = finest * 2 ** int(number)
        corners = np.array(
            [
                [x[chosen].min() - 2 * scale, y[chosen].min() - 2 * scale],
                [x[chosen].max() + 2 * scale, y[chosen].max() + 2 * scale],
            ]
        )
        grid = Grid.covering(corners, scale)
        texture = floor.region(grid)
        to_pixel = grid.pixel_from_metres
        columns = (to_pixel[0, 0] * x + to_pixel[0, 2]).astype(np.float32)
        lines = (to_pixel[1, 1] * y + to_pixel[1, 2]).astype(np.float32)
        read = cv2.remap(texture, columns, lines, cv2.INTER_LINEAR)
        image[band][chosen] = read[chosen]


def _to_walls(
    room: Room, world_from_robot: Pose2, x: Float32Array, y: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return the multiple of (x, y) in robot axes that meets a wall, and where along the walls."""
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


def _along(pixel_row: Float64Array, ray_row: Float64Array, count: int, axis: int) -> Float32Array:
    """Return where `count` rays meet the image along one axis, in its pixels."""
    metres = ray_row[axis] * np.arange(count) + ray_row[2]
    return np.asarray(pixel_row[axis] * metres + pixel_row[2], np.float32)


def _inside(corners: Float64Array, x: Float32Array, y: Float32Array) -> BoolArray:
    """Return which points lie inside a convex, counter-clockwise polygon."""
    inside = np.ones(x.shape, np.bool_)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = end - start
        inside &= edge[0] * (y - start[1]) - edge[1] * (x - start[0]) >= 0
    return inside
