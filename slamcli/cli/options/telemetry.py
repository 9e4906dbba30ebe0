"""Options of odometry, compass and GPS."""

from __future__ import annotations

from functools import partial

import click

from slamcli.cli.options.fields import option, stacked
from slamcli.cli.options.sections import SENSORS, expert, section
from slamcli.cli.options.values import PATH, Number, Numbers
from slamcli.core.bounds import STAMP, Bounds
from slamcli.core.telemetry import TelemetryOptions

_file = partial(option, "TelemetryFiles")
_TELEMETRY = TelemetryOptions()
_SECONDS = Numbers("SECONDS|auto", 1, limits=STAMP, auto=True)

_readings = section(
    SENSORS,
    _file(
        "odometry",
        "--odometry",
        PATH,
        "Odometry: CSV of stamp, x, y, heading, or TUM. Seconds, metres, radians. It gives poses "
        "where the floor shows no detail.",
    ),
    _file(
        "compass",
        "--compass",
        PATH,
        "Compass: CSV of stamp, heading or bearing. In radians, from east or from north.",
    ),
    _file(
        "gps",
        "--gps",
        PATH,
        "GPS: CSV of stamp, latitude, longitude. Degrees, WGS84; needs slamcli[geo].",
    ),
    click.option(  # of two dataclasses: auto is of TelemetryFiles
        "--time-offset",
        type=_SECONDS,
        default=_SECONDS.text((_TELEMETRY.time_offset_seconds,)),
        show_default=True,
        help="Added to the readings' stamps, seconds. It gives the frames' stamps; auto estimates "
        "it from odometry.",
    ),
)

_details = expert(
    SENSORS,
    option(
        _TELEMETRY,
        "lever_arm_metres",
        "--lever-arm",
        Numbers("AHEAD,LEFT|auto", 2, auto=True),
        "Metres from the robot's origin to the GPS antenna; auto estimates them. Of a bag by its "
        "static transforms, if it has them.",
    ),
    option(
        _TELEMETRY,
        "odometry_distance_share",
        "--odometry-sigma",
        Number(Bounds(1e-6, 1e3)),
        "Standard deviation of odometry's distances, as a share of them.",
    ),
)

telemetry_options = stacked(_readings, _details)
