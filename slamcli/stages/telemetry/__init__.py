"""Readings of odometry: interpolated, their clock found, and compared with what the frames show."""

from slamcli.stages.telemetry.agreement import (
    VisualMotions,
    clocks_apart,
    find_fault,
    find_heading_fault,
)
from slamcli.stages.telemetry.clock import TimeOffset, estimate_time_offset
from slamcli.stages.telemetry.odometry import (
    SAME_MOMENT_SECONDS,
    OdometryTrack,
    interpolate,
    interpolate_poses,
    motion_covariance,
)

__all__ = [
    "SAME_MOMENT_SECONDS",
    "OdometryTrack",
    "TimeOffset",
    "VisualMotions",
    "clocks_apart",
    "estimate_time_offset",
    "find_fault",
    "find_heading_fault",
    "interpolate",
    "interpolate_poses",
    "motion_covariance",
]
