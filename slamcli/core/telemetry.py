"""What the robot's other senses say, one record a reading, and how far each is to be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from slamcli.core.bounds import (
    ANGLE,
    COORDINATE,
    LATITUDE_DEGREES,
    LONGITUDE_DEGREES,
    READING_SIGMA_METRES,
    READING_SIGMA_RADIANS,
    SIGMA_METRES,
    SIGMA_RADIANS,
    STAMP,
    Bounds,
    quoted,
)
from slamcli.core.errors import InputError

if TYPE_CHECKING:  # numpy, which `slam --help` need not wait for
    from slamcli.core.arrays import Float64Array
    from slamcli.core.geometry import Pose2


# Typical of cheap sensors, for readings without a sigma of their own.
COMPASS_SIGMA_RADIANS = math.radians(3.0)
GPS_SIGMA_METRES = 3.0


@dataclass(frozen=True, slots=True)
class OdometryReading:
    """Wheels (or legs, or an inertial unit) added up.

    Attributes
    ----------
    stamp : float
        Seconds.
    pose : Pose2
        ``odom_from_robot``, from wherever the adding up began; it drifts and never jumps.
    """

    stamp: float
    pose: Pose2

    def __post_init__(self) -> None:
        _check("odometry", "stamp", self.stamp, STAMP)
        for name in ("x", "y", "theta"):
            _check("odometry", name, getattr(self.pose, name, None), COORDINATE)


@dataclass(frozen=True, slots=True)
class CompassReading:
    """Which way the robot looks.

    Attributes
    ----------
    stamp : float
        Seconds.
    heading_radians : float
        Counter-clockwise from east (ROS REP 103), off by a declination that all readings share.
    sigma_radians : float
        One standard deviation, without the declination; 0 is unknown: 3 degrees.
    """

    stamp: float
    heading_radians: float
    sigma_radians: float

    def __post_init__(self) -> None:
        _check("compass", "stamp", self.stamp, STAMP)
        _check("compass", "heading_radians", self.heading_radians, ANGLE)
        _check("compass", "sigma_radians", self.sigma_radians, READING_SIGMA_RADIANS)

    def with_sigma(self) -> CompassReading:
        """Return the reading with a typical sigma when its own is not known."""
        known = self.sigma_radians in SIGMA_RADIANS
        return self if known else replace(self, sigma_radians=COMPASS_SIGMA_RADIANS)


@dataclass(frozen=True, slots=True)
class GpsReading:
    """Where on Earth the antenna is.

    Attributes
    ----------
    stamp : float
        Seconds.
    latitude_degrees, longitude_degrees : float
        WGS84.
    sigma_metres : float
        One standard deviation, east and north alike; 0 is unknown: 3 m.
    """

    stamp: float
    latitude_degrees: float
    longitude_degrees: float
    sigma_metres: float

    def __post_init__(self) -> None:
        _check("GPS", "stamp", self.stamp, STAMP)
        _check("GPS", "latitude_degrees", self.latitude_degrees, LATITUDE_DEGREES)
        _check("GPS", "longitude_degrees", self.longitude_degrees, LONGITUDE_DEGREES)
        _check("GPS", "sigma_metres", self.sigma_metres, READING_SIGMA_METRES)

    def with_sigma(self) -> GpsReading:
        """Return the reading with a typical sigma when its own is not known."""
        known = self.sigma_metres in SIGMA_METRES
        return self if known else replace(self, sigma_metres=GPS_SIGMA_METRES)


def _check(what: str, name: str, value: object, limits: Bounds) -> None:
    if value not in limits:
        raise InputError(f"a {what} reading has {name} {quoted(value)}; {limits} is needed")


@dataclass(frozen=True, slots=True)
class TelemetryOptions:
    """How the other senses are read.

    Odometry errs mostly by constants that belong to wheels and floor: 2 % too long stays 2 % too
    long. Its variance therefore grows with distance times `odometry_memory_metres`, so that after
    that distance the sigma is the whole share, and it does not depend on how often one looks.

    Attributes
    ----------
    time_offset_seconds : float
        Added to the readings' stamps to get the frames' clock.
    lever_arm_metres : (float, float) or None
        Of the GPS antenna, ahead and to the left of the robot's origin; None estimates it.
    odometry_distance_share : float
        One standard deviation of the distance, as a share of it.
    odometry_heading_per_metre : float
        Of the heading, radians for each metre.
    odometry_turn_share : float
        Of a turn, as a share of it.
    odometry_metres, odometry_radians : float
        Of each motion besides, however short.
    odometry_memory_metres : float
    memory_seconds : float
        Readings of compass or GPS nearer in time than this err alike (iron nearby, echoes), and
        count as one together; each by itself may still be an outlier.
    longest_gap_seconds : float
        Between two readings of odometry that are interpolated.
    """

    time_offset_seconds: float = 0.0
    lever_arm_metres: tuple[float, float] | None = (0.0, 0.0)
    odometry_distance_share: float = 0.02
    odometry_heading_per_metre: float = 0.005
    odometry_turn_share: float = 0.02
    odometry_metres: float = 0.0005
    odometry_radians: float = 0.0005
    odometry_memory_metres: float = 10.0
    memory_seconds: float = 1.0
    max_gap_seconds: float = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Georeference:
    """Where on Earth a map lies, by GPS.

    Attributes
    ----------
    datum_degrees : (float, float)
        WGS84 latitude and longitude of the origin of the east-north plane.
    east_north_from_map : Pose2
        Metres east and north of the datum.
    covariance : (3, 3) float64
        Of that: x, y (m), theta (rad), east and north.
    lever_arm_metres : (float, float)
        Of the antenna, ahead and to the left of the robot's origin; given or estimated.
    readings, outliers : int
        GPS readings of the map's frames, and how many of them the others contradict.
    """

    datum_degrees: tuple[float, float]
    east_north_from_map: Pose2
    covariance: Float64Array
    lever_arm_metres: tuple[float, float]
    readings: int
    outliers: int
