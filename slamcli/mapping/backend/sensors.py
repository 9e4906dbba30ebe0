"""The other senses as links and factors between frames: odometry, compass, GPS."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right, insort
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from operator import attrgetter
from typing import TypeVar

from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import CompassReading, GpsReading, OdometryReading, TelemetryOptions
from slamcli.stages import telemetry
from slamcli.stages.geodesy import LocalPlane
from slamcli.stages.posegraph import HeadingReading, PositionReading, SensorOffsets

Kind = TypeVar("Kind", CompassReading, GpsReading)

_STAMP = attrgetter("stamp")
_SETTLED_RADIANS = 0.1


class Sensors:
    """All readings so far, in the frames' clock.

    Parameters
    ----------
    options : TelemetryOptions
    """

    def __init__(self, options: TelemetryOptions | None = None) -> None:
        self.options = options or TelemetryOptions()
        self.datum_degrees: tuple[float, float] | None = None
        self._track = telemetry.OdometryTrack(self.options)
        self._compass: list[CompassReading] = []
        self._gps: list[GpsReading] = []
        self._plane: LocalPlane | None = None

    @property
    def correct_the_map(self) -> bool:
        """Whether there are readings that tell of more than the motion since the last frame."""
        return bool(self._compass or self._gps)

    def are_settled(self, offsets: SensorOffsets) -> bool:
        """Return whether what all readings share is known well enough to be held nearly still."""
        east_north = offsets.east_north_covariance
        compass = not self._compass or offsets.compass_offset_sigma_radians < _SETTLED_RADIANS
        return compass and (not self._gps or math.sqrt(east_north[2, 2]) < _SETTLED_RADIANS)

    def shift(self, seconds: float) -> None:
        """Set by how much the readings' clock differs, before any odometry has come."""
        assert not len(self._track)
        self.options = replace(self.options, time_offset_seconds=seconds)
        self._track = telemetry.OdometryTrack(self.options)

    def geodetic(self, east_north: ArrayLike) -> Float64Array:
        """Return (N, 2) WGS84 latitude and longitude, degrees, of (N, 2) metres from the datum."""
        assert self._plane is not None
        return self._plane.geodetic(east_north)

    def odometry(self, reading: OdometryReading) -> None:
        """Take a reading."""
        self._track.add(reading)

    def compass(self, reading: CompassReading) -> None:
        """Take a reading."""
        insort(self._compass, reading, key=_STAMP)

    def gps(self, reading: GpsReading) -> None:
        """Take a reading; the first one is the datum. Raises InputError without pyproj."""
        if self._plane is None:
            self.datum_degrees = (float(reading.latitude_degrees), float(reading.longitude_degrees))
            self._plane = LocalPlane(self.datum_degrees)
        insort(self._gps, reading, key=_STAMP)

    def motion(self, begin: float | None, end: float | None) -> Pose2 | None:
        """Return ``begin_from_end`` by odometry, or None where it does not tell."""
        return self._track.motion(begin, end)

    def link(self, first: PoseEstimate, second: PoseEstimate) -> Link | None:
        """Return the motion between two frames by odometry, or None where it does not tell."""
        motion = self.motion(first.stamp, second.stamp)
        if motion is None:
            return None
        covariance = telemetry.motion_covariance(motion, self.options)
        return Link(first.index, second.index, motion, covariance, 0, math.nan, "odometry")

    def chain(self, frames: Sequence[PoseEstimate]) -> list[Link]:
        """Return the motions between frames that follow one another, where odometry tells them."""
        told = [f for f in frames if f.stamp is not None and self._track.at(f.stamp) is not None]
        links = (self.link(first, second) for first, second in pairwise(told))
        return [link for link in links if link is not None]

    def headings(self, frames: Sequence[PoseEstimate]) -> list[HeadingReading]:
        """Return the compass's readings, each tied to one of some placed frames."""
        near, share = self._near(self._compass, frames), self._share(self._compass)
        return [
            HeadingReading(index, motion, reading.heading_radians, reading.sigma_radians, share)
            for reading, (index, motion) in zip(near, self._tied(frames, near), strict=True)
            if index >= 0
        ]

    def places(self, frames: Sequence[PoseEstimate]) -> list[PositionReading]:
        """Return the GPS readings, each tied to one of some placed frames."""
        near, share = self._near(self._gps, frames), self._share(self._gps)
        places = []
        for reading, (index, motion) in zip(near, self._tied(frames, near), strict=True):
            if index >= 0 and self._plane is not None:
                place = self._plane.east_north(reading.latitude_degrees, reading.longitude_degrees)
                places.append(PositionReading(index, motion, *place, reading.sigma_metres, share))
        return places

    def _near(self, readings: Sequence[Kind], frames: Sequence[PoseEstimate]) -> Sequence[Kind]:
        """Return the readings of about the time of some frames: only these can be tied to them."""
        stamps = [frame.stamp for frame in frames if frame.stamp is not None]
        if not stamps:
            return []
        shift, gap = self.options.time_offset_seconds, self.options.max_gap_seconds
        first = bisect_left(readings, min(stamps) - gap - shift, key=_STAMP)
        return readings[first : bisect_right(readings, max(stamps) + gap - shift, key=_STAMP)]

    def _share(self, readings: Sequence[Kind]) -> float:
        """Return what one reading counts: of so many in the time over which they err alike."""
        if len(readings) < 2:
            return 1.0
        apart = (readings[-1].stamp - readings[0].stamp) / (len(readings) - 1)
        return min(1.0, apart / self.options.memory_seconds)

    def _tied(
        self, frames: Sequence[PoseEstimate], readings: Sequence[Kind]
    ) -> list[tuple[int, Pose2]]:
        """Return, for each reading, a frame's index and ``frame_from_robot`` at that moment.

        By odometry, else between the frames before and after it. Index -1 where neither tells.
        """
        stamped = sorted((f for f in frames if f.stamp is not None), key=_STAMP)
        moments = [frame.stamp for frame in stamped if frame.stamp is not None]
        shift = self.options.time_offset_seconds
        return [self._tie(stamped, moments, reading.stamp + shift) for reading in readings]

    def _tie(
        self, frames: Sequence[PoseEstimate], moments: Sequence[float], stamp: float
    ) -> tuple[int, Pose2]:
        none = (-1, Pose2())
        after = bisect_left(moments, stamp - telemetry.SAME_MOMENT_SECONDS)
        if after < len(moments) and moments[after] <= stamp + telemetry.SAME_MOMENT_SECONDS:
            return frames[after].index, Pose2()
        longest = self.options.max_gap_seconds
        if after > 0 and stamp - moments[after - 1] <= longest:
            felt = self.motion(moments[after - 1], stamp)
            if felt is not None:
                return frames[after - 1].index, felt
        if after in {0, len(moments)} or moments[after] - moments[after - 1] > longest:
            return none
        first, second = frames[after - 1], frames[after]
        begin, end = first.map_from_robot, second.map_from_robot
        if begin is None or end is None or first.fragment != second.fragment:
            return none
        share = (stamp - moments[after - 1]) / (moments[after] - moments[after - 1])
        return first.index, begin.inverse() @ telemetry.interpolate(begin, end, share)
