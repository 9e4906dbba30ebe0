"""`slam simulate`: a drive through a simulated world, with exact truth, as files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.projection import project_floor
from slamcli.core.errors import FrameError, InputError
from slamcli.core.geometry import Grid, Pose2, path_length
from slamcli.io import telemetry
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import write_image
from slamcli.io.frames import read_image
from slamcli.io.geojson import Polygon, write_polygons
from slamcli.io.outputs import output_folder
from slamcli.io.trajectories import read_path
from slamcli.run.command_report import Report
from slamcli.run.layouts import read_layout
from slamcli.run.session.session import Session
from slamcli.simulation import drive, floors, photograph
from slamcli.simulation.config import FloorOptions, SimulationOptions

PRODUCTS = (
    "frames",
    "square.png",
    "truth.csv",
    "obstacles.geojson",
    "odometry.csv",
    "compass.csv",
    "gps.csv",
    "camera.yaml",
)
# Start of a drive on the course, in its board's frame: a lap then stays around the middle.
COURSE_START = Pose2(-0.45, -0.45, 0.0)
_SQUARE_GRAY = 232.0
# Half of a gray level is this share of its light (sRGB, at the floor's 140).
_HALF_GRAY_IN_LIGHT = 0.23
_SQUARE_YAW_RADIANS = math.radians(7.0)
_SQUARE_MARGIN_PIXELS = 12
_SQUARE_NOISE_GRAY = 2.0
# Numbers of the random streams that a seed splits into.
_SENSORS, _BOXES, _SQUARE, _FRAMES, _WALKERS = range(5)
_WALL_METRES_PER_PIXEL = 0.002
# Those of 4K: the rays of a picture take some hundred bytes a pixel.
_MAX_PIXELS = 3840 * 2160


def simulate(
    output: Path,
    options: SimulationOptions,
    *,
    overwrite: bool,
    session: Session,
    layout: Path | None = None,
) -> Report:
    """Write frames, calibration photo, truth and sensors into `output`.

    Parameters
    ----------
    layout : Path, optional
        The file of a course's layout, in place of the options' own.

    Raises
    ------
    InputError, OutputError
    """
    if layout is not None:
        options = _laid_out(options, layout)
    _check_size(options.camera.size)
    calibration = photograph.make_camera(options.camera)
    poses = _poses(options)
    # The course's floor is laid around its board, not around the first frame's robot.
    world_from_map = COURSE_START if options.floor == "course" else Pose2()
    world = _world(options, calibration, poses, world_from_map)
    count = len(poses) - 1
    names = [f"{index:04d}.jpg" for index in range(count)]
    stamps = [index / options.frame_rate_hertz for index in range(count)]
    with output_folder(
        output, PRODUCTS, inputs=[Path(options.floor)], overwrite=overwrite
    ) as staging:
        # Before the drive's own photographer: each has the rays of a whole picture.
        photographed = partial(_photograph_square, calibration)
        (square,) = session.stage("photographing the square", photographed, [options])
        photographer = photograph.Photographer(world, calibration, options.imaging, options.seed)
        work = partial(_take, photographer, options, poses, world_from_map)
        images = session.stage("taking frames", work, range(count))
        for name, image in zip(names, images, strict=True):
            write_image(staging / "frames" / name, image, jpeg_quality=options.jpeg_quality)
        write_image(staging / "square.png", square)
        telemetry.write_truth(staging / "truth.csv", names, stamps, poses[:-1])
        write_polygons(staging / "obstacles.geojson", _obstacles(world, world_from_map))
        _write_sensors(staging, options, stamps, poses[:-1])
        save_calibration(staging / "camera.yaml", calibration)
    square_metres = options.square_side_metres
    line = f"{count} frames, truth, sensors and a {square_metres:g} m square in {output}"
    facts = {
        "frames": count,
        "length_metres": path_length(poses[:-1]),
        "square_side_metres": square_metres,
        "output": output,
        "files": PRODUCTS,
    }
    return Report((line,), facts)


def _check_size(size: tuple[int, int]) -> None:
    """Raise InputError when a picture's rays would not fit into memory."""
    if size[0] * size[1] > _MAX_PIXELS:
        raise InputError(
            f"frames of {size[0]}x{size[1]} pixels are too large to be simulated; at most "
            f"{_MAX_PIXELS / 1e6:g} million pixels"
        )


def _laid_out(options: SimulationOptions, layout: Path) -> SimulationOptions:
    if options.floor != "course":
        raise InputError("--layout needs --floor course")
    return replace(options, surface=replace(options.surface, layout=read_layout(layout)))


def _world(
    options: SimulationOptions,
    calibration: Calibration,
    poses: Sequence[Pose2],
    world_from_map: Pose2,
) -> photograph.World:
    """Return the floor with the boxes and walkers along the drive, and the room around it."""
    disturbances, rate = options.disturbances, options.frame_rate_hertz
    boxes = [
        *drive.scatter_boxes(
            poses, disturbances.boxes, rate, np.random.default_rng([options.seed, _BOXES])
        ),
        *drive.send_walkers(
            poses, disturbances.walkers, rate, np.random.default_rng([options.seed, _WALKERS])
        ),
    ]
    return photograph.World(
        _floor(options, calibration),
        tuple(replace(box, world_from_box=world_from_map @ box.world_from_box) for box in boxes),
        room=_room(options, world_from_map),
    )


def _obstacles(world: photograph.World, world_from_map: Pose2) -> list[Polygon]:
    """Return where boxes and walkers stand at stamp 0, in the map, and how they move."""
    found = []
    for box in world.boxes:
        map_from_box = world_from_map.inverse() @ box.world_from_box
        length, width, height = box.size_metres
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
        velocity = Pose2(0.0, 0.0, -world_from_map.theta).apply(box.velocity)
        properties = {
            "height_metres": round(height, 6),
            "velocity_x_metres_per_second": round(float(velocity[0]), 6),
            "velocity_y_metres_per_second": round(float(velocity[1]), 6),
        }
        found.append(Polygon(map_from_box.apply(corners), properties))
    return found


def _floor(options: SimulationOptions, calibration: Calibration) -> floors.Floor:
    if options.floor not in floors.FLOORS:
        try:
            image = read_image(Path(options.floor))
        except FrameError as error:
            kinds = ", ".join(floors.FLOORS)
            raise InputError(
                f"--floor {options.floor}: neither {kinds} nor a picture ({error})"
            ) from error
        return floors.picture_floor(
            image, options.floor_metres_per_pixel, in_light=options.imaging.light
        )
    resolution = photograph.texture_metres_per_pixel(calibration)
    return floors.make_floor(
        options.floor, options.surface, resolution, options.seed, in_light=options.imaging.light
    )


def _room(options: SimulationOptions, start: Pose2) -> photograph.Room | None:
    if options.room_metres == 0:
        return None
    wall = floors.make_wall(
        options.surface, _WALL_METRES_PER_PIXEL, options.seed, in_light=options.imaging.light
    )
    return photograph.Room((start.x, start.y), options.room_metres, wall)


def _poses(options: SimulationOptions) -> list[Pose2]:
    """Return one pose more than frames, in the map, whose origin is the first frame's robot."""
    if options.path in drive.PATHS:
        return drive.make_path(options)
    path = Path(options.path)
    if not path.is_file():
        kinds = ", ".join(drive.PATHS)
        raise InputError(f"--path {path}: neither {kinds} nor a file of poses")
    poses = read_path(path)
    if len(poses) < 2:
        raise InputError(f"{path} has {len(poses)} poses; at least 2 are needed for a drive")
    first = poses[0].inverse()
    relative = [first @ pose for pose in poses]
    return [*relative, relative[-1] @ (relative[-2].inverse() @ relative[-1])]


def _take(
    photographer: photograph.Photographer,
    options: SimulationOptions,
    poses: Sequence[Pose2],
    world_from_map: Pose2,
    index: int,
) -> UInt8Array:
    move = world_from_map @ poses[index], world_from_map @ poses[index + 1]
    stamp = index / options.frame_rate_hertz
    generator = np.random.default_rng([options.seed, _FRAMES, index])
    return photograph.take(photographer, move, stamp, options.disturbances, generator)


def _photograph_square(calibration: Calibration, options: SimulationOptions) -> UInt8Array:
    """Return a photo of a white square on plain floor, as large as fits wholly into the picture."""
    corners = _place_square(calibration, options.square_side_metres)
    floor = floors.make_floor(
        "concrete", FloorOptions(wear=0.0), 0.001, options.seed, in_light=options.imaging.light
    )
    world = photograph.World(_Darkened(floor), decals=(photograph.Decal(corners, _SQUARE_GRAY),))
    quiet = replace(
        options.disturbances,
        noise_gray=min(_SQUARE_NOISE_GRAY, options.disturbances.noise_gray),
        motion_blur=0.0,
        flicker=0.0,
        rocking_degrees=0.0,
        bounce_metres=0.0,
    )
    photographer = photograph.Photographer(world, calibration, options.imaging, options.seed)
    generator = np.random.default_rng([options.seed, _SQUARE])
    return photograph.take(photographer, (Pose2(), Pose2()), 0.0, quiet, generator)


def _place_square(calibration: Calibration, side_metres: float) -> Float64Array:
    """Return the (4, 2) corners of a square, slightly turned, that is seen whole and large."""
    half = side_metres / 2
    outline = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    width, height = calibration.image_size
    margin = _SQUARE_MARGIN_PIXELS
    for distance in np.linspace(0.0, 40 * side_metres, 400):
        corners = Pose2(float(distance), 0.0, _SQUARE_YAW_RADIANS).apply(outline)
        pixels, seen = project_floor(calibration, corners)
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        if seen.all() and low.min() > margin and np.all(high < (width - margin, height - margin)):
            return corners
    raise InputError(
        f"a square of {side_metres:g} m does not fit into the picture; "
        "use a smaller --square-side or another camera"
    )


class _Darkened:
    """A floor at half its gray level, so that a white square stands out of it."""

    def __init__(self, floor: floors.Floor) -> None:
        self.metres_per_pixel = floor.metres_per_pixel
        self.in_light = floor.in_light
        self._floor = floor

    def region(self, grid: Grid) -> floors.Texture:
        """Return the floor's pixels, halved; in light, that is less than a quarter of it."""
        pixels = self._floor.region(grid)
        if self.in_light:
            return (pixels * np.float32(_HALF_GRAY_IN_LIGHT)).astype(np.uint16)
        return pixels // np.uint8(2)


def _write_sensors(
    staging: Path, options: SimulationOptions, stamps: Sequence[float], poses: Sequence[Pose2]
) -> None:
    sensors = options.sensors
    readings = drive.sense(poses, sensors, np.random.default_rng([options.seed, _SENSORS]))
    telemetry.write_odometry(staging / "odometry.csv", stamps, readings.odometry)
    sigma = math.radians(sensors.compass_sigma_degrees)
    telemetry.write_compass(staging / "compass.csv", stamps, readings.compass_radians, sigma)
    telemetry.write_gps(staging / "gps.csv", stamps, readings.gps_degrees, sensors.gps_sigma_metres)
