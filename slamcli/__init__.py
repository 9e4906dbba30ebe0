"""Metric bird's-eye maps of the floor, and the robot's poses on it, from a camera's frames.

>>> import slamcli
>>> mapper = slamcli.Mapper(slamcli.load_calibration("calibration.yaml"))  # doctest: +SKIP
>>> estimate = mapper.update(frame)  # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module

# Not typing's: importing that alone costs a third of Python's own start.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from slamcli.core.camera.calibration import Calibration
    from slamcli.core.config import FeatureOptions, MapperOptions, MatchOptions
    from slamcli.core.errors import (
        CalibrationError,
        FrameError,
        InputError,
        MapError,
        OutputError,
        SlamcliError,
    )
    from slamcli.core.geometry import Grid, Pose2
    from slamcli.core.records import FloorMap, Frame, Link, PoseEstimate
    from slamcli.core.telemetry import (
        CompassReading,
        Georeference,
        GpsReading,
        OdometryReading,
        TelemetryOptions,
    )
    from slamcli.io.calibrations import load_calibration
    from slamcli.io.map_file import load_map
    from slamcli.mapping.localizer import Locator
    from slamcli.mapping.mapper import Mapper

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "slamcli.core.camera.calibration",
    "CalibrationError": "slamcli.core.errors",
    "CompassReading": "slamcli.core.telemetry",
    "FeatureOptions": "slamcli.core.config",
    "FloorMap": "slamcli.core.records",
    "Frame": "slamcli.core.records",
    "FrameError": "slamcli.core.errors",
    "Georeference": "slamcli.core.telemetry",
    "GpsReading": "slamcli.core.telemetry",
    "Grid": "slamcli.core.geometry",
    "InputError": "slamcli.core.errors",
    "Link": "slamcli.core.records",
    "Locator": "slamcli.mapping.localizer",
    "MapError": "slamcli.core.errors",
    "Mapper": "slamcli.mapping.mapper",
    "MapperOptions": "slamcli.core.config",
    "MatchOptions": "slamcli.core.config",
    "OdometryReading": "slamcli.core.telemetry",
    "OutputError": "slamcli.core.errors",
    "Pose2": "slamcli.core.geometry",
    "PoseEstimate": "slamcli.core.records",
    "SlamcliError": "slamcli.core.errors",
    "TelemetryOptions": "slamcli.core.telemetry",
    "load_calibration": "slamcli.io.calibrations",
    "load_map": "slamcli.io.map_file",
}

__all__ = [
    "Calibration",
    "CalibrationError",
    "CompassReading",
    "FeatureOptions",
    "FloorMap",
    "Frame",
    "FrameError",
    "Georeference",
    "GpsReading",
    "Grid",
    "InputError",
    "Link",
    "Locator",
    "MapError",
    "Mapper",
    "MapperOptions",
    "MatchOptions",
    "OdometryReading",
    "OutputError",
    "Pose2",
    "PoseEstimate",
    "SlamcliError",
    "TelemetryOptions",
    "__version__",
    "load_calibration",
    "load_map",
]


def __getattr__(name: str) -> Any:
    """Load a public name when it is first asked for, so that `slam --help` need not wait."""
    if name not in _HOMES:
        raise AttributeError(f"module 'slamcli' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
