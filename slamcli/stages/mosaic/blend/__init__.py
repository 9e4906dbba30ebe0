"""The blends: from all views of a tile to one image."""

from __future__ import annotations

from collections.abc import Callable

from slamcli.stages.mosaic.blend.averages import blend_feather, blend_mean, blend_median
from slamcli.stages.mosaic.blend.best import blend_best
from slamcli.stages.mosaic.blend.multiband import blend_multiband
from slamcli.stages.mosaic.blend.views import Blended, CellWindow, Views

__all__ = ["BLENDS", "Blended", "CellWindow", "Views"]

BLENDS: dict[str, Callable[[Views], Blended]] = {
    "best": blend_best,
    "feather": blend_feather,
    "multiband": blend_multiband,
    "median": blend_median,
    "mean": blend_mean,
}
