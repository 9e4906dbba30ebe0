"""The simulated drive: true poses, odometry, compass and GPS readings, and moving obstacles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.simulation.config import SensorOptions, SimulationOptions
from slamcli.simulation.photograph import Box

# WGS84 (NIMA TR8350.2): semi-major axis, m, and first eccentricity squared.
_WGS84_AXIS_METRES = 6378137.0
_WGS84_ECCENTRICITY_SQUARED = 6.69437999014e-3
_TURN_SHARE_OF_LANE = 0.5
# A drifting robot swings its heading by this much, this often, beside one slow turn about itself.
_SWING_RADIANS, _SWINGS = 0.5, 5
_LEG_METRES = (0.11, 0.10, 0.7)
_STRIDE_METRES = 0.35
_WALK_METRES_PER_SECOND = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Readings of the robot's other sensors, one per frame.

    Attributes
    ----------
    odometry : tuple of Pose2
        Integrated from the first frame.
    compass_radians : (N,) float64
        Heading, counter-clockwise from the map's x, declination and noise included.
    gps_degrees : (N, 2) float64
        WGS84 latitude and longitude.
    """

    odometry: tuple[Pose2, ...]
    compass_radians: Float64Array
    gps_degrees: Float64Array


def make_path(options: SimulationOptions) -> list[Pose2]:
    """Return `frames` + 1 poses (the last for the last frame's motion), from the origin on.

    The options' path is one of `PATHS`.
    """
    distances = np.linspace(0.0, options.length_metres, options.frames + 1)
    return PATHS[options.path](distances, options)


def _line(distances: Float64Array, _options: SimulationOptions) -> list[Pose2]:
    return [Pose2(float(distance)) for distance in distances]


def _loop(distances: Float64Array, options: SimulationOptions) -> list[Pose2]:
    """Return poses once around a circle to the left."""
    radius = options.length_metres / math.tau
    angles = distances / radius
    return [Pose2(radius * math.sin(a), radius * (1.0 - math.cos(a)), float(a)) for a in angles]


def _drift(distances: Float64Array, options: SimulationOptions) -> list[Pose2]:
    """Return poses once around a circle, the heading free of the path, as a drone's may be."""
    poses = _loop(distances, options)
    shares = distances / options.length_metres
    headings = -math.tau * shares + _SWING_RADIANS * np.sin(math.tau * _SWINGS * shares)
    return [
        Pose2(pose.x, pose.y, float(heading)) for pose, heading in zip(poses, headings, strict=True)
    ]


def _lawnmower(distances: Float64Array, options: SimulationOptions) -> list[Pose2]:
    """Return poses on straight lanes joined by half circles, alternately left and right."""
    lane, length = options.lane_metres, options.length_metres
    turn = math.pi * lane / 2
    lanes = max(2, round(math.sqrt(length / lane) * _TURN_SHARE_OF_LANE) + 1)
    straight = (length - (lanes - 1) * turn) / lanes
    if straight <= 0:
        lanes, straight = 2, max(0.0, (length - turn) / 2)
    poses = []
    for distance in distances:
        number, rest = divmod(float(distance), straight + turn)
        forward = int(number) % 2 == 0
        side = 1.0 if forward else -1.0
        along, heading = (0.0, 0.0) if forward else (straight, math.pi)
        origin = Pose2(along, lane * number, heading)
        if rest <= straight:
            poses.append(origin @ Pose2(rest))
            continue
        angle = (rest - straight) / (lane / 2)
        arc = Pose2(
            straight + lane / 2 * math.sin(angle),
            side * lane / 2 * (1.0 - math.cos(angle)),
            side * angle,
        )
        poses.append(origin @ arc)
    return poses


def sense(
    poses: Sequence[Pose2], options: SensorOptions, generator: np.random.Generator
) -> Readings:
    """Return odometry, compass and GPS readings along true poses ``map_from_robot``."""
    odometry = [Pose2()]
    for before, after in pairwise(poses):
        step = before.inverse() @ after
        noise = 1.0 + options.odometry_noise * generator.standard_normal(2)
        scale = float(noise[0]) * (1.0 + options.odometry_scale_error)
        drift = options.odometry_heading_drift * step.translation_length
        measured = Pose2(scale * step.x, scale * step.y, float(noise[1]) * step.theta + drift)
        odometry.append(odometry[-1] @ measured)
    count = len(poses)
    headings = np.array([pose.theta for pose in poses])
    compass = headings + math.radians(options.compass_declination_degrees)
    compass += math.radians(options.compass_sigma_degrees) * generator.standard_normal(count)
    positions = np.array([(pose.x, pose.y) for pose in poses])
    positions = positions + options.gps_sigma_metres * generator.standard_normal((count, 2))
    wrapped = (compass + math.pi) % math.tau - math.pi
    return Readings(tuple(odometry), wrapped, geodetic_from_local(positions, options.datum_degrees))


def geodetic_from_local(
    east_north: Float64Array, datum_degrees: tuple[float, float]
) -> Float64Array:
    """Return (N, 2) WGS84 latitude and longitude, degrees, of (N, 2) metres east and north.

    By the ellipsoid's radii of curvature at the datum (meridian and prime vertical; Snyder, Map
    Projections: A Working Manual, 1987, eqs. 4-18 and 4-20): good to millimetres within a
    kilometre.
    """
    latitude = math.radians(datum_degrees[0])
    curvature = 1.0 - _WGS84_ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    prime_vertical = _WGS84_AXIS_METRES / math.sqrt(curvature)
    meridian = prime_vertical * (1.0 - _WGS84_ECCENTRICITY_SQUARED) / curvature
    north = np.degrees(east_north[:, 1] / meridian)
    east = np.degrees(east_north[:, 0] / (prime_vertical * math.cos(latitude)))
    return np.column_stack([datum_degrees[0] + north, datum_degrees[1] + east])


def scatter_boxes(
    poses: Sequence[Pose2], count: int, frame_rate_hertz: float, generator: np.random.Generator
) -> tuple[Box, ...]:
    """Return cuboids beside and ahead of the path; every third one moves across it."""
    boxes = []
    for number in range(count):
        index = int(generator.integers(len(poses)))
        side = float(generator.choice([-1.0, 1.0]) * generator.uniform(0.2, 0.5))
        pose = poses[index] @ Pose2(float(generator.uniform(0.4, 0.9)), side)
        size = generator.uniform((0.04, 0.04, 0.04), (0.12, 0.12, 0.25))
        colour = generator.uniform(30, 220, 3)
        velocity = generator.uniform(-0.15, 0.15, 2) if number % 3 == 2 else np.zeros(2)
        # A moving box is where it was put when the robot passes.
        passed = index / frame_rate_hertz
        start = Pose2(pose.x - passed * velocity[0], pose.y - passed * velocity[1], pose.theta)
        boxes.append(
            Box(
                start,
                (float(size[0]), float(size[1]), float(size[2])),
                (float(colour[0]), float(colour[1]), float(colour[2])),
                (float(velocity[0]), float(velocity[1])),
            )
        )
    return tuple(boxes)


def send_walkers(
    poses: Sequence[Pose2], count: int, frame_rate_hertz: float, generator: np.random.Generator
) -> tuple[Box, ...]:
    """Return legs, as tall cuboids in pairs, that each cross the view when the robot is near."""
    legs = []
    for _ in range(count):
        index = int(generator.integers(len(poses)))
        pose = poses[index] @ Pose2(float(generator.uniform(0.45, 0.8)))
        bearing = pose.theta + float(generator.choice([-1.0, 1.0]) * generator.uniform(1.1, 2.0))
        velocity = _WALK_METRES_PER_SECOND * np.array([math.cos(bearing), math.sin(bearing)])
        passed = index / frame_rate_hertz
        start = Pose2(pose.x - passed * velocity[0], pose.y - passed * velocity[1], bearing)
        colour = tuple(float(value) for value in generator.uniform(20, 120, 3))
        for offset in (Pose2(), Pose2(-_STRIDE_METRES, 0.16)):
            walking = (float(velocity[0]), float(velocity[1]))
            legs.append(Box(start @ offset, _LEG_METRES, colour, walking))  # type: ignore[arg-type]
    return tuple(legs)


PATHS: dict[str, Callable[[Float64Array, SimulationOptions], list[Pose2]]] = {
    "line": _line,
    "loop": _loop,
    "lawnmower": _lawnmower,
    "drift": _drift,
}
