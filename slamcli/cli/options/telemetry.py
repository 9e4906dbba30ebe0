"""Options of odometry, compass and GPS."""

from __future__ import annotations

from functools import partial

import click

from slamcli.cli.options.fields import option, stacked
from slamcli.cli.options.values import PATH, Number, Numbers
from slamcli.core.bounds import STAMP, Bounds
from slamcli.core.telemetry import TelemetryOptions

_file = partial(option, "TelemetryFiles")
_TELEMETRY = TelemetryOptions()
_SECONDS = Numbers("SECONDS|auto", 1, limits=STAMP, auto=True)

telemetry_options = stacked(
    _file(
        "odometry",
        "--odometry",
        PATH,
        "Odometry: CSV with stamp (s), x, y (m), heading (rad), or a TUM file. It gives poses "
        "where the floor shows no detail.",
    ),
    _file(
        "compass",
        "--compass",
        PATH,
        "Headings: CSV with stamp and heading (rad from east) or bearing (from north).",
    ),
    _file(
        "gps",
        "--gps",
        PATH,
        "GPS positions: CSV with stamp, latitude, longitude (WGS84). Needs slamcli[geo].",
    ),
    click.option(  # of two dataclasses: auto is of TelemetryFiles
        "--time-offset",
        type=_SECONDS,
        default=_SECONDS.text((_TELEMETRY.time_offset_seconds,)),
        show_default=True,
        help="Added to the readings' stamps to get the frames'; auto estimates it from odometry.",
    ),
    option(
        _TELEMETRY,
        "lever_arm_metres",
        "--lever-arm",
        Numbers("AHEAD,LEFT|auto", 2, auto=True),
        "Metres from the robot's origin to the GPS antenna; auto estimates them.",
    ),
    option(
        _TELEMETRY,
        "odometry_distance_share",
        "--odometry-sigma",
        Number(Bounds(1e-6, 1e3)),
        "Standard deviation of odometry's distances, as a share of them.",
    ),
)
