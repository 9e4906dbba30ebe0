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

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array, UInt16Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import undistorted_coordinates
from slamcli.core.geometry import Grid, Pose2
from slamcli.simulation.floors import MAX_LEVEL, Floor
from slamcli.simulation.light import light_of_gray
from slamcli.simulation.photograph.world import Room, World

_RAYS_ACROSS, _RAYS_DOWN = 2, 4
_TILE_PIXELS = 64
# Floor beyond this many camera heights is a wall; nobody maps that far.
_WALL_HEIGHTS = 14.0
_WALL_BGR = (150.0, 162.0, 170.0)
_CEILING_METRES = 2.6
_MARGIN_PIXELS = 2


class Shutter(NamedTuple):
    """Where the robot is as the first and as the last row of a picture is exposed.

    Attributes
    ----------
    first, last : Pose2
        ``world_from_robot``; the same for a global shutter.
    """

    first: Pose2
    last: Pose2


class _Tile(NamedTuple):
    """A part of the picture, and the undistorted pixels of its rays, (h, w, 2) float32."""

    rows: slice
    columns: slice
    rays: Float32Array


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
        in_light = world.floor.in_light
        self._wall = np.array(
            [light_of_gray(gray) if in_light else gray for gray in _WALL_BGR], np.float32
        )
        width, height = calibration.image_size
        columns = (np.arange(width * _RAYS_ACROSS) + 0.5) / _RAYS_ACROSS - 0.5
        rows = (np.arange(height * _RAYS_DOWN) + 0.5) / _RAYS_DOWN - 0.5
        x, y = (a.astype(np.float32) for a in np.meshgrid(columns, rows))
        if np.any(calibration.distortion):
            x, y = undistorted_coordinates(calibration, x, y)
        rays = np.dstack([x, y])
        self._tiles = [
            _Tile(
                slice(top, min(top + _TILE_PIXELS, height)),
                slice(left, min(left + _TILE_PIXELS, width)),
                np.ascontiguousarray(
                    rays[
                        top * _RAYS_DOWN : (top + _TILE_PIXELS) * _RAYS_DOWN,
                        left * _RAYS_ACROSS : (left + _TILE_PIXELS) * _RAYS_ACROSS,
                    ]
                ),
            )
            for top in range(0, height, _TILE_PIXELS)
            for left in range(0, width, _TILE_PIXELS)
        ]

    def render(self, shutter: Shutter, calibration: Calibration) -> Float32Array:
        """Return (H, W, 3) float32 BGR of one instant, or of one roll of the shutter.

        Parameters
        ----------
        shutter : Shutter
        calibration : Calibration
            Where the camera stands at this moment: a rocking robot tilts and lifts it.
        """
        width, height = self.image_size
        picture = np.empty((height, width, 3), np.float32)
        for tile in self._tiles:
            rays = self._tile(tile, shutter, calibration)
            size = tile.columns.stop - tile.columns.start, tile.rows.stop - tile.rows.start
            picture[tile.rows, tile.columns] = cv2.resize(rays, size, interpolation=cv2.INTER_AREA)
        return picture

    def _tile(self, tile: _Tile, shutter: Shutter, calibration: Calibration) -> Float32Array:
        """Return a tile's rays, (h, w, 3) float32 BGR."""
        poses = [self._pose_at(shutter, row) for row in (tile.rows.start, tile.rows.stop)]
        seen = [pose.matrix @ calibration.robot_from_image for pose in poses]
        # The homogeneous scale of a floor point falls with its distance from the camera.
        far, near = _scales(tile.rays, calibration.robot_from_image)
        if not self._shows_floor_alone(tile, poses, far, calibration):
            return self._mixed(tile, poses[0], calibration)
        if _sampling(calibration, far) > 2.0 * _sampling(calibration, near):
            halves = _split(tile)
            if halves is not None:
                return np.vstack([self._tile(half, shutter, calibration) for half in halves])
        sampling = _sampling(calibration, math.sqrt(far * near))
        rays = self._floor(tile.rays, seen, sampling)
        self._add_decals(tile.rays, seen, rays)
        return rays

    def _pose_at(self, shutter: Shutter, row: int) -> Pose2:
        if shutter.first is shutter.last:
            return shutter.first
        share = row / self.image_size[1]
        motion = shutter.first.inverse() @ shutter.last
        return shutter.first @ Pose2(share * motion.x, share * motion.y, share * motion.theta)

    def _shows_floor_alone(
        self, tile: _Tile, poses: list[Pose2], far: float, calibration: Calibration
    ) -> bool:
        if far <= 0.0:
            return False
        robot = _carry(_rim(tile.rays), calibration.robot_from_image)
        if self.world.room is None:
            end = 0.98 * _WALL_HEIGHTS * calibration.height_metres
            return bool(np.hypot(robot[:, 0], robot[:, 1]).max() < end)
        half = 0.49 * self.world.room.side_metres
        return all(
            bool(np.abs(pose.apply(robot) - self.world.room.centre).max() < half) for pose in poses
        )

    def _floor(
        self, rays: Float32Array, world_from_image: list[Float64Array], sampling: float
    ) -> Float32Array:
        """Read the floor at a tile's rays from the level that a ray's own footprint asks for."""
        floor = self.world.floor
        level = min(
            max(round(math.log2(max(sampling / floor.metres_per_pixel, 1.0))), 0), MAX_LEVEL
        )
        scale = floor.metres_per_pixel * 2.0**level
        reached = np.vstack([_carry(_rim(rays), matrix) for matrix in world_from_image])
        margin = _MARGIN_PIXELS * scale
        corners = np.array([reached.min(axis=0) - margin, reached.max(axis=0) + margin])
        grid = Grid.covering(corners, scale)
        maps = [
            cv2.perspectiveTransform(rays, grid.pixel_from_metres @ matrix)
            for matrix in world_from_image
        ]
        places = maps[0]
        if world_from_image[0] is not world_from_image[1]:
            share = np.linspace(0.0, 1.0, len(rays), dtype=np.float32)[:, None, None]
            places = (1.0 - share) * maps[0] + share * maps[1]
        return _read_texture(floor.region(grid), places)

    def _add_decals(
        self, rays: Float32Array, world_from_image: list[Float64Array], picture: Float32Array
    ) -> None:
        """Draw plain figures over the floor, their edges mixed by how much of a ray they cover."""
        for decal in self.world.decals:
            image_from_world = np.linalg.inv(world_from_image[0])
            cover = np.ones(rays.shape[:2], np.float32)
            ends = (
                np.column_stack([decal.corners, np.ones(len(decal.corners))]) @ image_from_world.T
            )
            if ends[:, 2].min() <= 0.0:
                continue
            for start, end in zip(ends, np.roll(ends, -1, axis=0), strict=True):
                # The edge as a line of the undistorted picture; the inside is on its left there.
                line = np.cross(start, end)
                line *= -1.0 / np.hypot(line[0], line[1])
                distance = rays @ line[:2].astype(np.float32) + np.float32(line[2])
                wide = abs(line[0]) / _RAYS_ACROSS + abs(line[1]) / _RAYS_DOWN
                cover *= np.clip(0.5 + distance / np.float32(wide), 0.0, 1.0)
            picture += cover[..., None] * (decal.gray - picture)

    def _mixed(self, tile: _Tile, pose: Pose2, calibration: Calibration) -> Float32Array:
        """Return a tile that shows the horizon, walls or floor too far away, ray by ray."""
        inverse = calibration.robot_from_image
        columns, rows = tile.rays[..., 0], tile.rays[..., 1]
        x, y, w = (
            np.float32(r[0]) * columns + np.float32(r[1]) * rows + np.float32(r[2]) for r in inverse
        )
        room = self.world.room
        if room is None:
            far = np.float32(calibration.height_metres * _WALL_HEIGHTS)
            on_floor = (w > 0) & (x * x + y * y <= (far * w) ** 2)
        else:
            reach, wall_x = _to_walls(room, pose, x, y)
            on_floor = w * reach > 1.0
        picture = np.empty((*w.shape, 3), np.float32)
        picture[:] = self._wall
        safe = np.where(on_floor, w, np.float32(1.0))
        m = pose.matrix.astype(np.float32)
        floor_x, floor_y = x / safe, y / safe
        world_x = m[0, 0] * floor_x + m[0, 1] * floor_y + m[0, 2]
        world_y = m[1, 0] * floor_x + m[1, 1] * floor_y + m[1, 2]
        _read(self.world.floor, world_x, world_y, _samplings(calibration, safe), on_floor, picture)
        if room is not None:
            up = np.float32(calibration.height_metres) * (1.0 - reach * w)
            finer = reach * np.hypot(x, y) / calibration.camera_matrix[0, 0] / 2.0
            _read(room.wall, wall_x, up, finer, ~on_floor & (up < _CEILING_METRES), picture)
        floor_only = picture.copy()
        self._add_decals(tile.rays, [m @ inverse, m @ inverse], floor_only)
        return np.where(on_floor[..., None], floor_only, picture)


def _scales(rays: Float32Array, robot_from_image: Float64Array) -> tuple[float, float]:
    """Return the least and the greatest homogeneous scale of a tile's rays on the floor."""
    scales = _rim(rays) @ robot_from_image[2, :2] + robot_from_image[2, 2]
    return float(scales.min()), float(scales.max())


def _sampling(calibration: Calibration, scale: float) -> float:
    """Return metres of floor to a ray, the mean of both directions, at a homogeneous scale."""
    area = abs(float(np.linalg.det(calibration.robot_from_image)))
    return math.sqrt(area / (_RAYS_ACROSS * _RAYS_DOWN) / scale**3)


def _samplings(calibration: Calibration, scales: Float32Array) -> Float32Array:
    area = abs(float(np.linalg.det(calibration.robot_from_image)))
    return np.sqrt(area / (_RAYS_ACROSS * _RAYS_DOWN) / scales**3)


def _rim(rays: Float32Array) -> Float64Array:
    """Return the (N, 2) rays all around a tile: what lies between them lies within on the floor."""
    around = rays[0], rays[-1], rays[:, 0], rays[:, -1]
    return np.concatenate(around).astype(np.float64)


def _carry(points: Float64Array, matrix: Float64Array) -> Float64Array:
    return cv2.perspectiveTransform(points[None], matrix)[0]


def _split(tile: _Tile) -> list[_Tile] | None:
    """Return a tile's halves along its longer side; None when it is small."""
    height, width = tile.rows.stop - tile.rows.start, tile.columns.stop - tile.columns.start
    if max(height, width) < 16:
        return None
    middle = tile.rows.start + height // 2
    cut = (height // 2) * _RAYS_DOWN
    return [
        _Tile(slice(tile.rows.start, middle), tile.columns, tile.rays[:cut]),
        _Tile(slice(middle, tile.rows.stop), tile.columns, tile.rays[cut:]),
    ]


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
        margin = _MARGIN_PIXELS * scale
        corners = np.array(
            [
                [world_x[chosen].min() - margin, world_y[chosen].min() - margin],
                [world_x[chosen].max() + margin, world_y[chosen].max() + margin],
            ]
        )
        grid = Grid.covering(corners, scale)
        to_pixel = grid.pixel_from_metres
        columns = to_pixel[0, 0] * world_x + to_pixel[0, 2]
        rows = to_pixel[1, 1] * world_y + to_pixel[1, 2]
        places = np.dstack([columns, rows]).astype(np.float32)
        picture[chosen] = _read_texture(floor.region(grid), places)[chosen]


def _read_texture(texture: UInt8Array | UInt16Array, places: Float32Array) -> Float32Array:
    """Return a texture's values at (h, w, 2) pixels, on the scale on which white is 255."""
    read = cv2.remap(texture, places, None, cv2.INTER_LINEAR).astype(np.float32)
    if texture.dtype == np.uint16:
        read *= np.float32(255.0 / 65535.0)
    return read


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
