"""What is painted and written, and in which forms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import click

from slamcli.cli.options.common import metres_per_pixel, stacked
from slamcli.cli.options.values import POSITIVE, Bytes, Choices, Reals
from slamcli.core.config import Datum, PaintOptions, ProductOptions

_PRODUCTS = ProductOptions()

product_options = stacked(
    metres_per_pixel,
    click.option(
        "--blend",
        type=click.Choice(["best", "feather", "multiband", "median", "mean"]),
        default=_PRODUCTS.paint.blend,
        show_default=True,
        help="How the views of a spot become one: best takes the sharpest and hides the seams.",
    ),
    click.option(
        "--gain/--no-gain",
        default=_PRODUCTS.paint.gain,
        help="Even out exposure and vignetting [default], or paint pictures as they are.",
    ),
    click.option(
        "--obstacles/--no-obstacles",
        default=_PRODUCTS.paint.obstacles,
        help="Keep what is not floor out of the map, in obstacles.png [default], or not.",
    ),
    click.option(
        "--format",
        "formats",
        type=Choices(("png", "geotiff", "deepzoom", "nav2")),
        default="png",
        show_default=True,
        help="Of the map, separated by commas: png, geotiff, deepzoom, nav2.",
    ),
    click.option(
        "--layers",
        type=Choices(("resolution", "views", "last-frame")),
        default="",
        help="Also write for every pixel, separated by commas: resolution, views, last-frame.",
    ),
    click.option(
        "--nav-lines", is_flag=True, help="Nav2: painted lines are obstacles, not what stands."
    ),
    click.option(
        "--nav-resolution",
        type=POSITIVE,
        default=_PRODUCTS.nav_metres_per_pixel,
        show_default=True,
        help="Nav2: metres a pixel, at most.",
    ),
    click.option(
        "--rotate", type=float, default=0.0, show_default=True, help="Degrees counter-clockwise."
    ),
    click.option(
        "--crop",
        type=Reals((4,), "x_min,y_min,x_max,y_max"),
        help="Paint only x_min,y_min,x_max,y_max, metres in the rotated map.",
    ),
    click.option(
        "--datum",
        type=Reals((2, 3), "latitude,longitude[,heading]"),
        help="GeoTIFF: latitude,longitude of the map's origin and, counter-clockwise from east, "
        "the heading of its x axis, degrees.",
    ),
    click.option(
        "--memory",
        type=Bytes(),
        default="1.4G",
        show_default=True,
        help="FrameCache and canvases get what the poses leave of it; the map may be larger.",
    ),
)


def products_of(told: Mapping[str, Any]) -> ProductOptions:
    """Return what the flags of `product_options` ask for."""
    datum = told["datum"]
    return ProductOptions(
        paint=PaintOptions(
            metres_per_pixel=told["metres_per_pixel"],
            blend=told["blend"],
            gain=told["gain"],
            obstacles=told["obstacles"],
        ),
        formats=told["formats"],
        layers=told["layers"],
        nav_lines=told["nav_lines"],
        nav_metres_per_pixel=told["nav_resolution"],
        turn_radians=math.radians(told["rotate"]),
        crop=told["crop"],
        memory_bytes=told["memory"],
        datum=None
        if datum is None
        else Datum(datum[0], datum[1], math.radians(datum[2] if len(datum) > 2 else 0.0)),
    )
