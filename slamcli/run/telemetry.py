"""Telemetry: the readings of odometry, compass and GPS, given to the mapper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamcli.core.errors import InputError
from slamcli.core.geometry import pose_array
from slamcli.core.telemetry import (
    CompassReading,
    GpsReading,
    OdometryReading,
    TelemetryOptions,
)
from slamcli.io.containers.bag import is_bag
from slamcli.io.containers.bag_readings import antenna_metres, has_readings, reading_topics
from slamcli.io.telemetry import read_compass, read_gps, read_odometry
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.mapping.mapper import Mapper
from slamcli.run.inputs import Inputs
from slamcli.stages.telemetry import clocks_apart, estimate_time_offset


@dataclass(frozen=True, slots=True)
class TelemetryFiles:
    """The files of the readings, each optional.

    Attributes
    ----------
    odometry, compass, gps : Path or None
    find_time_offset : bool
        Estimate the offset of their clock from odometry and the poses of the frames.
    """

    odometry: Path | None = None
    compass: Path | None = None
    gps: Path | None = None
    find_time_offset: bool = False

    @property
    def any(self) -> bool:
        """Whether there is a file at all."""
        return any(path is not None for path in (self.odometry, self.compass, self.gps))


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """All sensor readings of a drive.

    Attributes
    ----------
    odometry, compass, gps : lists
    find_time_offset : bool
    """

    odometry: list[OdometryReading]
    compass: list[CompassReading]
    gps: list[GpsReading]
    find_time_offset: bool


def unused_note(sources: Sequence[Path], files: TelemetryFiles) -> str:
    """Return which readings of bags are not used, as no option names them; empty for none."""
    given = {"--odometry": files.odometry, "--gps": files.gps, "--compass": files.compass}
    lines = []
    for path in filter(is_bag, sources):
        found = reading_topics(path)
        unused = [f"{option} ({found[option]})" for option in found if given[option] is None]
        if unused:
            lines.append(
                f"{path.name} also has readings for {', '.join(unused)}: name it there to use them"
            )
    return "\n".join(lines)


def with_antenna(options: TelemetryOptions, gps: Path | None) -> tuple[TelemetryOptions, str]:
    """Return the options with the antenna's place that the bag of GPS readings has, and a note.

    They are as they were, and the note is empty, where a lever arm is given or none is known.
    """
    given = options.lever_arm_metres != TelemetryOptions().lever_arm_metres
    if gps is None or given or not has_readings(gps):
        return options, ""
    lever = antenna_metres(gps)
    if lever is None:
        return options, ""
    note = f"{gps.name} has the antenna's place: --lever-arm {lever[0]:.9g},{lever[1]:.9g}"
    return replace(options, lever_arm_metres=lever), note


def read_telemetry(
    files: TelemetryFiles, inputs: Inputs, time_offset_seconds: float = 0.0
) -> Telemetry:
    """Return the readings of all files that were named.

    Raises
    ------
    InputError
        Also when the frames have no stamps to tie readings to, are not in metres, or are of another
        time than the readings with the offset of their clock.
    """
    named = next((p for p in (files.odometry, files.compass, files.gps) if p is not None), None)
    if named is not None and all(frame.stamp is None for frame in inputs.files):
        raise InputError(f"{named} has stamps and the frames have none; give --frame-rate")
    metric = files.odometry or files.gps
    if metric is not None and inputs.calibration.unit != "m":
        raise InputError(f"{metric} is in metres and the frames are in pixels; give --calibration")
    if files.find_time_offset and files.odometry is None:
        raise InputError("--time-offset auto needs --odometry")
    read = Telemetry(
        [] if files.odometry is None else read_odometry(files.odometry),
        [] if files.compass is None else read_compass(files.compass),
        [] if files.gps is None else read_gps(files.gps),
        files.find_time_offset,
    )
    stamps = [frame.stamp for frame in inputs.files if frame.stamp is not None]
    pairs = (
        (files.odometry, read.odometry),
        (files.compass, read.compass),
        (files.gps, read.gps),
    )
    for path, readings in pairs:
        if readings and not files.find_time_offset:
            moments = [reading.stamp + time_offset_seconds for reading in readings]
            first, last = min(moments), max(moments)
            if last < min(stamps) or first > max(stamps):
                ends = (min(stamps), max(stamps))
                fault = clocks_apart((first, last), ends, time_offset_seconds)
                raise InputError(f"{path} {fault}")
    return read


def feed(mapper: Mapper, telemetry: Telemetry) -> None:
    """Pass all readings to the mapper. Raises InputError without pyproj for GPS."""
    for odometry in telemetry.odometry:
        mapper.odometry(odometry)
    for compass in telemetry.compass:
        mapper.compass(compass)
    for gps in telemetry.gps:
        mapper.gps(gps)


def feed_shifted(mapper: Mapper, telemetry: Telemetry) -> str:
    """Estimate the offset of the clocks from the poses so far, then feed; return it as text.

    Raises
    ------
    InputError
        When the motion does not determine the offset.
    """
    members = max(placed_fragments(mapper.estimates).values(), key=len, default=[])
    seen = [e for e in members if e.map_from_robot is not None and e.stamp is not None]
    poses = [e.map_from_robot for e in seen if e.map_from_robot is not None]
    odometry = telemetry.odometry
    stamps = np.array([reading.stamp for reading in odometry])
    moments = np.array([e.stamp for e in seen if e.stamp is not None])
    # Clocks of other epochs: both are taken to have begun together, within what is searched.
    apart = bool(len(moments)) and (stamps[-1] < moments[0] or stamps[0] > moments[-1])
    rough = float(moments[0] - stamps[0]) if apart else 0.0
    found = estimate_time_offset(
        (stamps + rough, pose_array([r.pose for r in odometry])), (moments, pose_array(poses))
    )
    if found is None:
        raise InputError(
            "the motion is too even, or too short, to estimate the offset of the clocks; "
            "give --time-offset in seconds"
        )
    seconds = rough + found.seconds
    mapper.sensors.shift(seconds)
    feed(mapper, telemetry)
    return f"{seconds:+.3f} s, sigma {found.sigma_seconds:.3f} s"
