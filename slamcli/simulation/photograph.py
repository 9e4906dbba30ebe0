"""What a camera over a floor sees: perspective, lens, boxes, blur, noise, and no aliasing.

Each pixel is the mean of several rays, more along the line of sight, where a pixel covers most
floor; each ray reads the floor from the pyramid level that matches what is left for it to cover.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import choose_max_range, seen_floor
from slamcli.core.camera.lens import distort_points, image_centre, undistorted_coordinates
from slamcli.core.camera.mounting import (
    compose_robot_from_image,
    image_from_robot_homography,
    robot_from_camera_rotation,
)
from slamcli.core.camera.resolution import floor_sampling
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.simulation.config import CameraOptions, DisturbanceOptions
from slamcli.simulation.floors import Floor

_RAYS_ACROSS, _RAYS_DOWN = 2, 4
# Floor beyond this many camera heights is a wall; nobody maps that far.
_WALL_HEIGHTS = 14.0
_WALL_BGR = (150.0, 162.0, 170.0)
_MAX_LEVEL = 5
_CEILING_METRES = 2.6
_BLUR_POSES = 5
_FINEST_METRES_PER_PIXEL, _COARSEST_METRES_PER_PIXEL = 0.00025, 0.001


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A cuboid that stands on the floor.

    Attributes
    ----------
    world_from_box : Pose2
        Of its centre, at stamp 0.
    size_metres : (float, float, float)
        Length, width, height.
    colour : (float, float, float)
        BGR of its top; the sides are darker.
    velocity : (float, float)
        Metres a second, in the world.
    """

    world_from_box: Pose2
    size_metres: tuple[float, float, float]
    colour: tuple[float, float, float]
    velocity: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Decal:
    """A flat, convex, plain figure on the floor, such as a calibration square.

    Attributes
    ----------
    corners : (N, 2) float64
        World metres, counter-clockwise.
    gray : float
    """

    corners: Float64Array
    gray: float


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Four walls that stand on the floor.

    Attributes
    ----------
    centre : (float, float)
        World metres.
    side_metres : float
    wall : Floor
        Its texture: x along the walls, all around, y up from the floor.
    """

    centre: tuple[float, float]
    side_metres: float
    wall: Floor


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """All that there is to see.

    Attributes
    ----------
    floor : Floor
    boxes, decals : tuple
    room : Room or None
    """

    floor: Floor
    boxes: tuple[Box, ...] = ()
    decals: tuple[Decal, ...] = ()
    room: Room | None = None


def make_camera(options: CameraOptions) -> Calibration:
    """Return the true calibration of a simulated camera."""
    focal = options.size[0] / 2 / math.tan(math.radians(options.field_of_view_degrees) / 2)
    centre_x, centre_y = image_centre(options.size)
    matrix = np.array([[focal, 0.0, centre_x], [0.0, focal, centre_y], [0.0, 0.0, 1.0]])
    pitch, roll = math.radians(options.pitch_degrees), math.radians(options.roll_degrees)
    image_from_robot = image_from_robot_homography(matrix, options.height_metres, pitch, roll)
    return Calibration(
        camera_matrix=matrix,
        distortion=np.array([options.k1, options.k2, 0.0, 0.0, 0.0]),
        distortion_model="plumb_bob",
        image_size=options.size,
        robot_from_image=compose_robot_from_image(matrix, options.height_metres, pitch, roll),
        height_metres=options.height_metres,
        pitch_radians=pitch,
        roll_radians=roll,
        max_range_metres=choose_max_range(matrix, image_from_robot, options.size),
    )


def texture_metres_per_pixel(calibration: Calibration) -> float:
    """Return how fine a floor is made: enough for the near edge, no finer than the camera's eye."""
    nearest = floor_sampling(calibration, seen_floor(calibration))[:, 1].min()
    finest = _FINEST_METRES_PER_PIXEL
    fitting = float(finest * 2.0 ** round(math.log2(float(nearest) / finest)))
    return min(max(fitting, finest), _COARSEST_METRES_PER_PIXEL)


def tilted(
    calibration: Calibration, pitch_radians: float, roll_radians: float, height_metres: float
) -> Calibration:
    """Return the camera turned and lifted by small amounts, as a rocking robot holds it."""
    height = calibration.height_metres + height_metres
    pitch = calibration.pitch_radians + pitch_radians
    roll = calibration.roll_radians + roll_radians
    return replace(
        calibration,
        robot_from_image=compose_robot_from_image(calibration.camera_matrix, height, pitch, roll),
        height_metres=height,
        pitch_radians=pitch,
        roll_radians=roll,
    )


class Photographer:
    """Takes pictures of a world with one camera.

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
        place = world_from_robot.matrix.astype(np.float32)
        world_x = place[0, 0] * floor[..., 0] + place[0, 1] * floor[..., 1] + place[0, 2]
        world_y = place[1, 0] * floor[..., 0] + place[1, 1] * floor[..., 1] + place[1, 2]
        picture = np.empty((*world_x.shape, 3), np.float32)
        picture[:] = np.array(_WALL_BGR, np.float32)
        _read(self.world.floor, world_x, world_y, sampling, on_floor, picture)
        if room is not None:
            up = np.float32(calibration.height_metres) * (1.0 - reach * w)
            finer = reach * np.hypot(x, y) / calibration.camera_matrix[0, 0] / 2.0
            _read(room.wall, wall_x, up, finer, ~on_floor & (up < _CEILING_METRES), picture)
        for decal in self.world.decals:
            picture[on_floor & _inside(decal.corners, world_x, world_y)] = decal.gray
        width, height = calibration.image_size
        small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        image = np.asarray(small, np.float32)
        _draw_boxes(image, self.world.boxes, world_from_robot, calibration, stamp)
        return image


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
        picture[band][chosen] = np.asarray(read)[chosen]


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


def take(
    photographer: Photographer,
    way: tuple[Pose2, Pose2],
    stamp: float,
    disturbances: DisturbanceOptions,
    generator: np.random.Generator,
) -> UInt8Array:
    """Return one frame (H, W, 3) uint8 BGR.

    Parameters
    ----------
    way : (Pose2, Pose2)
        world_from_robot of this frame and of the next, between which the shutter is open.
    stamp : float
        Seconds.
    generator : Generator
        Of this frame alone, so that frames can be taken in any order.
    """
    rocking = math.radians(disturbances.rocking_degrees) * generator.standard_normal(2)
    bounce = disturbances.bounce_metres * generator.standard_normal()
    gain = 1.0 + disturbances.flicker * generator.uniform(-1.0, 1.0)
    calibration = tilted(
        photographer.calibration, float(rocking[0]), float(rocking[1]), float(bounce)
    )
    start, end = way
    motion = start.inverse() @ end
    count = _BLUR_POSES if disturbances.motion_blur > 0 else 1
    total = np.zeros((*calibration.image_size[::-1], 3), np.float32)
    for number in range(count):
        share = disturbances.motion_blur * (number / max(1, count - 1) - 0.5)
        moved = start @ Pose2(share * motion.x, share * motion.y, share * motion.theta)
        total += photographer.expose(moved, calibration, stamp)
    image = total * np.float32(gain / count) * _vignette(calibration, disturbances.vignetting)
    image = (
        image
        + disturbances.noise_gray
        * generator.standard_normal(image.shape[:2], dtype=np.float32)[..., None]
    )
    return np.asarray(np.clip(np.round(image), 0, 255), np.uint8)


def _vignette(calibration: Calibration, share: float) -> Float32Array:
    """Return (H, W, 1): the brightness lost towards the corners, by the square of the radius."""
    width, height = calibration.image_size
    centre_x, centre_y = image_centre(calibration.image_size)
    x, y = np.meshgrid(np.arange(width) - centre_x, np.arange(height) - centre_y)
    radius_squared = (x * x + y * y) / (centre_x**2 + centre_y**2)
    return np.asarray(1.0 - share * radius_squared, np.float32)[..., None]


def _along(pixel_row: Float64Array, ray_row: Float64Array, count: int, axis: int) -> Float32Array:
    """Return where `count` rays meet the picture along one axis, in its pixels."""
    metres = ray_row[axis] * np.arange(count) + ray_row[2]
    return np.asarray(pixel_row[axis] * metres + pixel_row[2], np.float32)


def _inside(corners: Float64Array, x: Float32Array, y: Float32Array) -> BoolArray:
    """Return which points lie inside a convex, counter-clockwise polygon."""
    inside = np.ones(x.shape, np.bool_)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = end - start
        inside &= edge[0] * (y - start[1]) - edge[1] * (x - start[0]) >= 0
    return inside


def _draw_boxes(
    image: Float32Array,
    boxes: tuple[Box, ...],
    world_from_robot: Pose2,
    calibration: Calibration,
    stamp: float,
) -> None:
    """Draw cuboids into a picture, far ones first; one partly behind the camera is left out."""
    faces = []
    for box in boxes:
        moved = Pose2(
            box.world_from_box.x + stamp * box.velocity[0],
            box.world_from_box.y + stamp * box.velocity[1],
            box.world_from_box.theta,
        )
        faces += _box_faces(box, world_from_robot.inverse() @ moved, calibration)
    for _, polygon, colour in sorted(faces, key=lambda face: -face[0]):
        fixed = np.round(polygon * 16).astype(np.int32)
        cv2.fillConvexPoly(image, fixed, colour, cv2.LINE_AA, 4)


def _box_faces(
    box: Box, robot_from_box: Pose2, calibration: Calibration
) -> list[tuple[float, Float64Array, tuple[float, float, float]]]:
    """Return (distance, (N, 2) pixels, colour) of the faces that look at the camera."""
    length, width, height = box.size_metres
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    base = robot_from_box.apply(outline)
    bottom = np.column_stack([base, np.zeros(4)])
    top = np.column_stack([base, np.full(4, height)])
    eye = np.array([0.0, 0.0, calibration.height_metres])
    candidates = [(top, 1.0)]
    for side in range(4):
        following = (side + 1) % 4
        corners = np.array([bottom[side], bottom[following], top[following], top[side]])
        candidates.append((corners, 0.55 + 0.1 * side))
    faces = []
    for corners, shade in candidates:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        if normal @ (eye - corners[0]) <= 0:
            continue
        rim = np.concatenate(
            [
                np.linspace(corners[number - 1], corners[number], 6, endpoint=False)
                for number in range(len(corners))
            ]
        )
        pixels = _project(rim, calibration)
        if pixels is not None:
            distance = float(np.linalg.norm(corners.mean(axis=0) - eye))
            faces.append((distance, pixels, tuple(shade * value for value in box.colour)))
    return faces  # type: ignore[return-value]


def _project(points: Float64Array, calibration: Calibration) -> Float64Array | None:
    """Project (N, 3) robot points, metres, to pixels; None when one is not well ahead."""
    rotation = robot_from_camera_rotation(calibration.pitch_radians, calibration.roll_radians)
    rays = (points - (0.0, 0.0, calibration.height_metres)) @ rotation
    if rays[:, 2].min() < 0.05:
        return None
    undistorted = apply_homography(calibration.camera_matrix, rays[:, :2] / rays[:, 2:])
    # Far outside the picture the lens polynomial folds back into it.
    reach = 0.9 if np.any(calibration.distortion) else 4.0
    centre = np.array(image_centre(calibration.image_size))
    if np.abs(undistorted - centre).max() > reach * max(calibration.image_size):
        return None
    return distort_points(calibration, undistorted)
