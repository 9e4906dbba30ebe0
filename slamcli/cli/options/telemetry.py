"""Readings of the robot's other senses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from slamcli.cli.options.common import stacked
from slamcli.cli.options.values import PATH, POSITIVE, Measured
from slamcli.core.telemetry import TelemetryOptions

_TELEMETRY = TelemetryOptions()

telemetry_options = stacked(
    click.option(
        "--odometry",
        type=PATH,
        help="The robot's odometry: CSV with stamp (s), x, y (m), heading (rad), or TUM. It "
        "carries the robot over floor that shows nothing.",
    ),
    click.option(
        "--compass",
        type=PATH,
        help="Headings: CSV with stamp and heading (rad from east) or bearing (from north).",
    ),
    click.option(
        "--gps",
        type=PATH,
        help="Places: CSV with stamp, latitude, longitude (WGS84). Needs slamcli[geo].",
    ),
    click.option(
        "--time-offset",
        type=Measured(1, "SECONDS|auto"),
        default="0",
        show_default=True,
        help="Added to the readings' stamps to get the frames'. auto finds it from odometry.",
    ),
    click.option(
        "--lever-arm",
        type=Measured(2, "AHEAD,LEFT|auto"),
        default="0,0",
        show_default=True,
        help="Metres from the robot's origin to the GPS antenna. auto estimates it.",
    ),
    click.option(
        "--odometry-sigma",
        type=POSITIVE,
        default=_TELEMETRY.odometry_distance_share,
        show_default=True,
        help="One standard deviation of odometry's distances, as a share of them.",
    ),
)


def telemetry_of(told: Mapping[str, Any]) -> TelemetryOptions:
    """Return what the flags of a command that takes readings ask for."""
    offset = told["time_offset"]
    return TelemetryOptions(
        time_offset_seconds=0.0 if offset is None else offset[0],
        lever_arm_metres=told["lever_arm"],
        odometry_distance_share=told["odometry_sigma"],
    )
