"""Options of all stages, with their defaults; the command line and run.toml use the same fields."""

from slamcli.core.config.mapping import MapperOptions
from slamcli.core.config.products import (
    Blend,
    Datum,
    Layer,
    MapFormat,
    PaintOptions,
    ProductOptions,
)
from slamcli.core.config.registration import (
    FeatureMethod,
    FeatureOptions,
    MatchFilter,
    MatchOptions,
    NetworkFiles,
    TransformModel,
)
from slamcli.core.config.selection import FrameSelection

__all__ = [
    "Blend",
    "Datum",
    "FeatureMethod",
    "FeatureOptions",
    "FrameSelection",
    "Layer",
    "MapFormat",
    "MapperOptions",
    "MatchFilter",
    "MatchOptions",
    "NetworkFiles",
    "PaintOptions",
    "ProductOptions",
    "TransformModel",
]
