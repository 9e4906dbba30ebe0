"""Odometry, compass and GPS readings as factors of the pose graph."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from operator import attrgetter
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import CompassReading, GpsReading, OdometryReading, TelemetryOptions
from slamcli.stages import telemetry
from slamcli.stages.geodesy import LocalPlane
from slamcli.stages.posegraph import HeadingReading, PositionReading, SensorOffsets

Reading = TypeVar("Reading", CompassReading, GpsReading)

_STAMP = attrgetter("stamp")
# An angle offset with a smaller sigma is known: from then on windows may take it as a prior.
# [guarded by tests/mapping/backend/test_sensors.py]
_MAX_KNOWN_SIGMA_RADIANS = 0.1
# Odometry is compared with this many frames first, and with half as many again each time.
_FIRST_CHECK = 5
# Nobody drives nearer to a pole; the plane of a datum there has no east. [by definition]
_MAX_LATITUDE_DEGREES = 89.9


class StampedFrame(Protocol):
    """A frame with its time: a `PreparedFrame` or a `PoseEstimate`."""

    @property
    def index(self) -> int:
        """Index of the frame."""
        ...

    @property
    def stamp(self) -> float | None:
        """Seconds, or None when it is not known."""
        ...


class Sensors:
    """All readings so far, in the frames' clock.

    Parameters
    ----------
    options : TelemetryOptions
    """

    def __init__(self, options: TelemetryOptions | None = None) -> None:
        self.options = options or TelemetryOptions()
        self.datum_degrees: tuple[float, float] | None = None
        # GPS readings of a receiver without a fix: outliers from the start.
        self.no_fixes = 0
        self._track = telemetry.OdometryTrack(self.options)
        self._seen = telemetry.VisualMotions()
        self._next_check = _FIRST_CHECK
        # In which way odometry contradicts the frames; it is then used no more. Empty if not.
        self.odometry_fault = ""
        # The same of the compass, and of GPS.
        self.compass_fault = self.gps_fault = ""
        self._compass: list[CompassReading] = []
        self._gps: list[GpsReading] = []
        self._plane: LocalPlane | None = None

    @property
    def correct_the_map(self) -> bool:
        """Whether there are absolute readings (compass, GPS), which correct drift."""
        return bool(self._compass or self._gps)

    def are_known(self, offsets: SensorOffsets) -> bool:
        """Return whether the offsets that all readings share are known well enough for a prior."""
        east_north = offsets.east_north_covariance
        compass = offsets.compass_offset_sigma_radians < _MAX_KNOWN_SIGMA_RADIANS
        gps = math.sqrt(east_north[2, 2]) < _MAX_KNOWN_SIGMA_RADIANS
        return (not self._compass or compass) and (not self._gps or gps)

    def shift(self, seconds: float) -> None:
        """Set the difference of the readings' clock, before the first odometry reading."""
        assert not len(self._track)
        self.options = replace(self.options, time_offset_seconds=seconds)
        self._track = telemetry.OdometryTrack(self.options)

    def geodetic(self, east_north: ArrayLike) -> Float64Array:
        """Return (N, 2) WGS84 latitude and longitude, degrees, of (N, 2) metres from the datum."""
        assert self._plane is not None
        return self._plane.geodetic(east_north)

    def odometry(self, reading: OdometryReading) -> None:
        """Add a reading."""
        self._track.add(reading)

    def compass(self, reading: CompassReading) -> None:
        """Add a reading."""
        insort(self._compass, reading.with_sigma(), key=_STAMP)

    def gps(self, reading: GpsReading) -> None:
        """Add a reading; the first one is the datum. Raises InputError without pyproj.

        Receivers without a fix report 0, 0 or a pole: these are no datum, as the readings that
        follow would lie beyond its plane.
        """
        if _is_no_fix(reading):
            self.no_fixes += 1
            return
        if self._plane is None:
            self.datum_degrees = (float(reading.latitude_degrees), float(reading.longitude_degrees))
            self._plane = LocalPlane(self.datum_degrees)
        insort(self._gps, reading.with_sigma(), key=_STAMP)

    def motion(self, begin: float | None, end: float | None) -> Pose2 | None:
        """Return ``begin_from_end`` by odometry; None without readings about those moments.

        Nor with readings that contradict the frames.
        """
        return None if self.odometry_fault else self._track.motion(begin, end)

    def compare(self, first: StampedFrame, second: StampedFrame, motion: Pose2) -> None:
        """Take the motion that two pictures determined; compare the odometry now and then."""
        if first.stamp is None or second.stamp is None:
            return
        self._seen.add((first.index, first.stamp), (second.index, second.stamp), motion)
        if len(self._seen) >= self._next_check:
            self._next_check += max(_FIRST_CHECK, self._next_check // 2)
            self.check()

    def check(self) -> None:
        """Compare all odometry with all that the frames showed so far."""
        self.odometry_fault = telemetry.find_fault(
            *self._track.arrays(), self._seen, self.options.time_offset_seconds
        )
        shift = self.options.time_offset_seconds
        stamps = np.array([reading.stamp + shift for reading in self._compass])
        headings = np.array([reading.heading_radians for reading in self._compass])
        self.compass_fault = telemetry.find_heading_fault(stamps, headings, self._seen)

    @property
    def odometry_readings(self) -> int:
        """The number of readings of odometry."""
        return len(self._track)

    @property
    def compared(self) -> int:
        """The number of frames that odometry could be compared with."""
        return len(self._seen)

    @property
    def faults(self) -> list[str]:
        """What is wrong with the readings, a line each; those of a contradiction are not used."""
        named = (
            ("odometry", self.odometry_fault),
            ("compass", self.compass_fault),
            ("GPS", self.gps_fault),
        )
        found = [f"{sensor} {fault}" for sensor, fault in named if fault]
        found += [
            f"odometry is reset at {stamp:.3f} s: motions across that moment are not used"
            for stamp in self._track.resets
        ]
        if self.no_fixes:
            found.append(f"GPS has {self.no_fixes} readings without a fix, at 0, 0 or a pole")
        return found

    def link(self, first: StampedFrame, second: StampedFrame) -> Link | None:
        """Return the motion between two frames by odometry; None without readings for it."""
        motion = self.motion(first.stamp, second.stamp)
        if motion is None:
            return None
        covariance = telemetry.motion_covariance(motion, self.options)
        return Link(first.index, second.index, motion, covariance, 0, math.nan, "odometry")

    def chain(self, frames: Sequence[PoseEstimate]) -> list[Link]:
        """Return the motions between frames that follow one another, where there is odometry."""
        covered = [f for f in frames if f.stamp is not None and self._track.at(f.stamp) is not None]
        links = (self.link(first, second) for first, second in pairwise(covered))
        return [link for link in links if link is not None]

    def headings(self, frames: Sequence[PoseEstimate]) -> list[HeadingReading]:
        """Return the compass readings about some placed frames, each attached to one of them."""
        if self.compass_fault:
            return []
        near, share = self._near(self._compass, frames), self._share(self._compass)
        return [
            HeadingReading(index, motion, reading.heading_radians, reading.sigma_radians, share)
            for reading, (index, motion) in zip(near, self._attached(frames, near), strict=True)
            if index >= 0
        ]

    def positions(self, frames: Sequence[PoseEstimate]) -> list[PositionReading]:
        """Return the GPS readings about some placed frames, each attached to one of them."""
        near, share = self._near(self._gps, frames), self._share(self._gps)
        positions = []
        for reading, (index, motion) in zip(near, self._attached(frames, near), strict=True):
            if index >= 0 and self._plane is not None:
                east, north = self._plane.east_north(
                    reading.latitude_degrees, reading.longitude_degrees
                )
                if not (math.isfinite(east) and math.isfinite(north)):
                    continue
                positions.append(
                    PositionReading(index, motion, east, north, reading.sigma_metres, share)
                )
        return positions

    def _near(
        self, readings: Sequence[Reading], frames: Sequence[PoseEstimate]
    ) -> Sequence[Reading]:
        """Return the readings about the time of some frames: only these can be attached to them."""
        stamps = [frame.stamp for frame in frames if frame.stamp is not None]
        if not stamps:
            return []
        shift, gap = self.options.time_offset_seconds, self.options.max_gap_seconds
        first = bisect_left(readings, min(stamps) - gap - shift, key=_STAMP)
        return readings[first : bisect_right(readings, max(stamps) + gap - shift, key=_STAMP)]

    def _share(self, readings: Sequence[Reading]) -> float:
        """Return the weight of a reading: 1 over their number in the errors' correlation time."""
        if len(readings) < 2:
            return 1.0
        apart = (readings[-1].stamp - readings[0].stamp) / (len(readings) - 1)
        return min(1.0, apart / self.options.memory_seconds)

    def _attached(
        self, frames: Sequence[PoseEstimate], readings: Sequence[Reading]
    ) -> list[tuple[int, Pose2]]:
        """Return, for each reading, a frame's index and ``frame_from_robot`` at that moment.

        By odometry, else interpolated between the frames before and after it. Index -1 where
        neither is possible.
        """
        stamped = sorted((f for f in frames if f.stamp is not None), key=_STAMP)
        moments = [frame.stamp for frame in stamped if frame.stamp is not None]
        shift = self.options.time_offset_seconds
        return [self._attach(stamped, moments, reading.stamp + shift) for reading in readings]

    def _attach(
        self, frames: Sequence[PoseEstimate], moments: Sequence[float], stamp: float
    ) -> tuple[int, Pose2]:
        none = (-1, Pose2())
        after = bisect_left(moments, stamp - telemetry.SAME_MOMENT_SECONDS)
        if after < len(moments) and moments[after] <= stamp + telemetry.SAME_MOMENT_SECONDS:
            return frames[after].index, Pose2()
        max_gap = self.options.max_gap_seconds
        if after > 0 and stamp - moments[after - 1] <= max_gap:
            measured = self.motion(moments[after - 1], stamp)
            if measured is not None:
                return frames[after - 1].index, measured
        if after in {0, len(moments)} or moments[after] - moments[after - 1] > max_gap:
            return none
        first, second = frames[after - 1], frames[after]
        begin, end = first.map_from_robot, second.map_from_robot
        if begin is None or end is None or first.fragment != second.fragment:
            return none
        share = (stamp - moments[after - 1]) / (moments[after] - moments[after - 1])
        return first.index, begin.inverse() @ telemetry.interpolate(begin, end, share)


def _is_no_fix(reading: GpsReading) -> bool:
    """Return whether a reading lies where receivers without a fix say that they are."""
    latitude, longitude = abs(reading.latitude_degrees), abs(reading.longitude_degrees)
    return latitude > _MAX_LATITUDE_DEGREES or (latitude == 0.0 and longitude == 0.0)
