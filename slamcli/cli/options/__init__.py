"""Every command-line option that more than one command takes, defined once."""

from slamcli.cli.options.common import (
    calibration,
    frames,
    max_range,
    metres_per_pixel,
    output,
    overwrite,
    picked,
    scheduler,
    seed,
    self_calibrate,
    strict,
    workers,
)
from slamcli.cli.options.features import FEATURES, feature_details, networks_of
from slamcli.cli.options.mapping import mapper_of, mapper_options
from slamcli.cli.options.matching import match_details
from slamcli.cli.options.products import product_options, products_of
from slamcli.cli.options.simulation import (
    camera_options,
    disturbance_options,
    floor_options,
    path_options,
)
from slamcli.cli.options.telemetry import telemetry_of, telemetry_options
from slamcli.cli.options.values import NOT_NEGATIVE, PATH, POSITIVE, Choices

__all__ = [
    "FEATURES",
    "NOT_NEGATIVE",
    "PATH",
    "POSITIVE",
    "Choices",
    "calibration",
    "camera_options",
    "disturbance_options",
    "feature_details",
    "floor_options",
    "frames",
    "mapper_of",
    "mapper_options",
    "match_details",
    "max_range",
    "metres_per_pixel",
    "networks_of",
    "output",
    "overwrite",
    "path_options",
    "picked",
    "product_options",
    "products_of",
    "scheduler",
    "seed",
    "self_calibrate",
    "strict",
    "telemetry_of",
    "telemetry_options",
    "workers",
]
