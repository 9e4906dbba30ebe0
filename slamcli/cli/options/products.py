"""Options of the map that is painted and of the files that are written."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import click

from slamcli.cli.options.common import metres_per_pixel
from slamcli.cli.options.fields import option, stacked
from slamcli.cli.options.sections import OUTPUT, PERFORMANCE, expert, section
from slamcli.cli.options.values import Bytes, CoordinateSystem, Degrees, Number, Numbers, Words
from slamcli.core.bounds import LATITUDE_DEGREES, LONGITUDE_DEGREES, METRES_PER_PIXEL
from slamcli.core.config import Datum, ProductOptions

_product = partial(option, ProductOptions())
_paint = partial(option, ProductOptions().paint)


def _datum(_context: Any, _option: Any, value: tuple[float, ...] | None) -> Datum | None:
    """Return the datum of latitude, longitude and, where it is given, heading in degrees."""
    if not value:
        return None
    latitude, longitude, *heading = value
    if latitude not in LATITUDE_DEGREES or longitude not in LONGITUDE_DEGREES:
        raise click.BadParameter(
            f"latitude {latitude:g}, longitude {longitude:g} is no place on Earth"
        )
    return Datum(latitude, longitude, *map(math.radians, heading))


_painting = expert(
    OUTPUT,
    _paint(
        "blend",
        "--blend",
        click.Choice(["best", "feather", "multiband", "median", "mean"]),
        "How several views of one spot are blended; best takes the sharpest and hides the seams.",
    ),
    _paint("gain", "--gain/--no-gain", text="Even out exposure and vignetting."),
    _paint(
        "obstacles",
        "--obstacles/--no-obstacles",
        text="Keep obstacles on the floor out of the map, in obstacles.png.",
    ),
)

_files = section(
    OUTPUT,
    _product(
        "formats",
        "--format",
        Words("png", "geotiff", "deepzoom", "nav2"),
        "Formats: png, geotiff, deepzoom, nav2. Separated by commas.",
    ),
)

_file_details = expert(
    OUTPUT,
    _product(
        "layers",
        "--layers",
        Words("resolution", "views", "last-frame"),
        "Also write for every pixel, separated by commas: resolution, views (their number), "
        "last-frame.",
    ),
    _product(
        "nav_lines",
        "--nav-lines",
        text="Nav2: mark painted lines as occupied, in place of obstacles.",
    ),
    _product(
        "nav_metres_per_pixel",
        "--nav-resolution",
        Number(METRES_PER_PIXEL),
        "Nav2: metres per pixel of the occupancy grid, at most; never finer than the map.",
    ),
    _product(
        "turn_radians",
        "--rotate",
        Degrees(),
        "Degrees by which the map is rotated, counter-clockwise.",
    ),
    _product(
        "crop",
        "--crop",
        Numbers("x_min,y_min,x_max,y_max", 4),
        "Paint only x_min,y_min,x_max,y_max, metres in the rotated map.",
    ),
    _product(
        "datum",
        "--datum",
        Numbers("latitude,longitude[,heading]", 2, 3),
        "GeoTIFF: latitude,longitude of the map's origin and the heading of its x axis, "
        "counter-clockwise from east, in degrees.",
        callback=_datum,
    ),
    _product(
        "crs",
        "--crs",
        CoordinateSystem(),
        "Write a GeoTIFF in this coordinate system, of metres; auto is the UTM zone.",
    ),
)

_memory = expert(
    PERFORMANCE,
    _product(
        "memory_bytes",
        "--memory",
        Bytes(),
        "Memory of the whole process; the map may be larger than it.",
    ),
)

product_options = stacked(metres_per_pixel, _painting, _files, _file_details, _memory)
