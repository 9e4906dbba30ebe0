"""Metric bird's-eye maps of the floor, and the robot's poses on it, from a camera's frames.

>>> import slamcli
>>> mapper = slamcli.Mapper(slamcli.load_calibration("calibration.yaml"))  # doctest: +SKIP
>>> estimate = mapper.update(frame)  # doctest: +SKIP
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.1.0"

# The public names by module, loaded when they are first used: `slam --help` needs none of them.
# Type checkers read them in __init__.pyi, which a test compares.
_NAMES = {
    "slamcli.core.camera.calibration": "Calibration",
    "slamcli.core.config": "FeatureOptions MapperOptions MatchOptions",
    "slamcli.core.errors": (
        "CalibrationError FrameError InputError MapError OutputError SlamcliError"
    ),
    "slamcli.core.geometry": "Grid Pose2",
    "slamcli.core.records": "FloorMap Frame Link PoseEstimate",
    "slamcli.core.telemetry": (
        "CompassReading Georeference GpsReading OdometryReading TelemetryOptions"
    ),
    "slamcli.io.calibrations": "load_calibration",
    "slamcli.io.map_file": "load_map",
    "slamcli.mapping.localizer": "Follower Locator",
    "slamcli.mapping.mapper": "Mapper",
    "slamcli.mapping.self_calibration": "self_calibrate",
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(["__version__", *_MODULES])


def __getattr__(name: str) -> object:
    """Return a public name from its module."""
    if name not in _MODULES:
        raise AttributeError(f"module 'slamcli' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return __all__
