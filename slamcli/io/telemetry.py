"""Odometry, compass, GPS and ground truth: one CSV each.

Lengths in metres, angles in radians counter-clockwise, stamps in seconds, WGS84 in degrees.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import (
    LATITUDE_DEGREES,
    LONGITUDE_DEGREES,
    READING_SIGMA_METRES,
    READING_SIGMA_RADIANS,
    STAMP,
)
from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2
from slamcli.core.telemetry import (
    COMPASS_SIGMA_RADIANS,
    GPS_SIGMA_METRES,
    CompassReading,
    GpsReading,
    OdometryReading,
)
from slamcli.io.containers.bag_readings import (
    has_readings,
    read_bag_compass,
    read_bag_gps,
    read_bag_odometry,
)
from slamcli.io.csv_table import HEADINGS, STAMPS, Table, parse_table
from slamcli.io.files import read_text, write_text
from slamcli.io.gps_tracks import is_track, read_track
from slamcli.io.trajectories import read_trajectory

# No robot on a floor turns that fast for a tenth of its way, one and a half times around a second
# [guarded by tests/stages/test_telemetry.py].
_MAX_SPIN_RADIANS_PER_SECOND, _SPIN_PERCENTILE = 10.0, 90.0
# Clockwise from north, as a hand-held compass reads.
_BEARINGS = ("bearing", "azimuth")
_LATITUDES = (
    *("latitude", "lat", "latitude_deg", "lat_deg", "gps_lat", "gps_latitude", ".latitude", ".lat"),
)
_LONGITUDES = (
    *("longitude", "lon", "lng", "long", "longitude_deg", "lon_deg", "gps_lon", "gps_long"),
    *("gps_longitude", ".longitude", ".lon"),
)
_COMPASS_SIGMAS = ("sigma", "sigma_heading", "sigma_yaw")
_GPS_SIGMAS = (
    *("sigma", "sigma_metres", "accuracy", "horizontal_accuracy", "horizontalaccuracy"),
    *("h_acc", "hacc"),
)


def write_truth(
    path: Path, names: Sequence[str], stamps: Sequence[float], poses: Sequence[Pose2]
) -> None:
    """Write index, frame, stamp, x, y, heading: ``map_from_robot`` of every frame."""
    rows = (
        (str(index), name, f"{stamp:.6f}", *_pose(pose))
        for index, (name, stamp, pose) in enumerate(zip(names, stamps, poses, strict=True))
    )
    _write(path, ("index", "frame", "stamp", "x", "y", "heading"), rows)


def write_odometry(path: Path, stamps: Sequence[float], poses: Sequence[Pose2]) -> None:
    """Write stamp, x, y, heading: the pose integrated from the start, drift included."""
    rows = ((f"{stamp:.6f}", *_pose(pose)) for stamp, pose in zip(stamps, poses, strict=True))
    _write(path, ("stamp", "x", "y", "heading"), rows)


def write_compass(
    path: Path, stamps: Sequence[float], headings_radians: Float64Array, sigmas: ArrayLike
) -> None:
    """Write stamp, heading and sigma (rad), one for all or one for each."""
    columns = stamps, headings_radians, np.broadcast_to(sigmas, len(stamps))
    rows = (
        (f"{stamp:.6f}", f"{heading:.6f}", f"{sigma:.6f}")
        for stamp, heading, sigma in zip(*columns, strict=True)
    )
    _write(path, ("stamp", "heading", "sigma"), rows)


def write_gps(
    path: Path, stamps: Sequence[float], places_degrees: Float64Array, sigmas: ArrayLike
) -> None:
    """Write stamp, latitude, longitude (degrees, WGS84) and sigma (m), one for all or for each."""
    columns = stamps, places_degrees, np.broadcast_to(sigmas, len(stamps))
    rows = (
        (f"{stamp:.6f}", f"{latitude:.10f}", f"{longitude:.10f}", f"{sigma:.3f}")
        for stamp, (latitude, longitude), sigma in zip(*columns, strict=True)
    )
    _write(path, ("stamp", "latitude", "longitude", "sigma"), rows)


def read_odometry(path: Path) -> list[OdometryReading]:
    """Return the readings of a CSV with columns stamp (s), x, y (m), heading (rad), TUM or a bag.

    ``heading_degrees`` is converted. The poses are integrated, from any origin.

    Raises
    ------
    InputError
        One line that names the file, and the line of it where there is one.
    """
    if has_readings(path):
        return read_bag_odometry(path)
    track = read_trajectory(path)
    if track.stamps is None:
        raise InputError(f"{path} has poses without stamps; odometry needs a column stamp")
    _refuse_backwards(path, track.stamps, None)
    if track.headings is not None:
        _refuse_degrees(path, track.stamps, track.headings)
    return [
        OdometryReading(stamp, Pose2(*pose))
        for stamp, pose in zip(track.stamps.tolist(), track.poses.tolist(), strict=True)
    ]


def read_compass(path: Path) -> list[CompassReading]:
    """Return the readings of a CSV with columns stamp (s), heading (rad), perhaps sigma, or a bag.

    Headings are counter-clockwise from east; a column ``bearing`` is clockwise from north. Each
    may be in degrees: ``heading_degrees``, ``bearing_degrees``, ``sigma_degrees``.

    Raises
    ------
    InputError
        One line that names the file, and the line of it where there is one.
    """
    if has_readings(path):
        return read_bag_compass(path)
    table = _read(path, "compass readings")
    stamps = _stamps(table)
    if table.has_angles(_BEARINGS) and not table.has_angles(HEADINGS):
        headings = math.pi / 2 - table.angles(_BEARINGS)
    else:
        headings = table.angles(HEADINGS)
    sigmas = np.full(len(table), COMPASS_SIGMA_RADIANS)
    if table.has_angles(_COMPASS_SIGMAS):
        sigmas = table.angles(_COMPASS_SIGMAS, READING_SIGMA_RADIANS)
    _refuse_backwards(path, stamps, table)
    readings = []
    for line, *row in zip(table.lines, stamps.tolist(), headings, sigmas, strict=True):
        try:
            readings.append(CompassReading(row[0], float(row[1]), float(row[2])))
        except InputError as error:
            raise InputError(f"{path}, line {line}: {error}") from error
    return readings


def read_gps(path: Path) -> list[GpsReading]:
    """Return the readings of a CSV with stamp (s), latitude, longitude, perhaps sigma, or a bag.

    Degrees, WGS84; sigma in metres, east and north alike.

    Raises
    ------
    InputError
        One line that names the file, and the line of it where there is one.
    """
    if has_readings(path):
        return read_bag_gps(path)
    text = read_text(path, "GPS readings")
    if is_track(text):
        return read_track(path, text)
    table = _parsed(path, "GPS readings", text)
    stamps = _stamps(table)
    latitudes = table.numbers(_LATITUDES, LATITUDE_DEGREES)
    longitudes = table.numbers(_LONGITUDES, LONGITUDE_DEGREES)
    sigmas = np.full(len(table), GPS_SIGMA_METRES)
    if table.has(_GPS_SIGMAS):
        sigmas = table.lengths(_GPS_SIGMAS, READING_SIGMA_METRES)
    _refuse_backwards(path, stamps, table)
    readings = []
    columns = (latitudes, longitudes, sigmas)
    for line, *row in zip(table.lines, stamps.tolist(), *columns, strict=True):
        try:
            readings.append(GpsReading(row[0], float(row[1]), float(row[2]), float(row[3])))
        except InputError as error:
            raise InputError(f"{path}, line {line}: {error}") from error
    return readings


def _stamps(table: Table) -> Float64Array:
    stamps = table.stamps(STAMP)
    return table.numbers(STAMPS, STAMP) if stamps is None else stamps


def _read(path: Path, what: str) -> Table:
    return _parsed(path, what, read_text(path, what))


def _parsed(path: Path, what: str, text: str) -> Table:
    table = parse_table(path, text)
    if not len(table):
        raise InputError(f"{path} has no {what}")
    return table


def _refuse_backwards(path: Path, stamps: Float64Array, table: Table | None) -> None:
    backwards = np.flatnonzero(np.diff(stamps) < 0.0)
    if len(backwards):
        row = int(backwards[0]) + 1
        place = f"line {table.lines[row]}" if table is not None else f"reading {row + 1}"
        raise InputError(
            f"{path}, {place}: the stamp {stamps[row]:.6f} comes after {stamps[row - 1]:.6f}; "
            "sort the readings by time"
        )


def _refuse_degrees(path: Path, stamps: Float64Array, headings: Float64Array) -> None:
    """Refuse headings that spin as no robot does: degrees taken for radians."""
    spans = np.diff(stamps)
    moving = spans > 0.0
    if not moving.any() or np.abs(headings).max() <= math.tau:
        return
    rates = np.abs(np.diff(headings))[moving] / spans[moving]
    usual = float(np.percentile(rates, _SPIN_PERCENTILE))
    if usual > _MAX_SPIN_RADIANS_PER_SECOND:
        raise InputError(
            f"{path}: headings up to {np.abs(headings).max():.4g} that change by {usual:.3g} a "
            "second are in degrees, not radians; name the column heading_degrees"
        )


def _pose(pose: Pose2) -> tuple[str, str, str]:
    return f"{pose.x:.7f}", f"{pose.y:.7f}", f"{pose.theta:.8f}"


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, stream.getvalue())
