"""Control points: pixels of frames whose places on the ground were measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import COORDINATE, LATITUDE_DEGREES, LONGITUDE_DEGREES
from slamcli.core.errors import InputError
from slamcli.io.csv_table import parse_table
from slamcli.io.files import read_text

_FRAME, _COLUMN, _ROW = ("frame", "name", "file"), ("column", "u", "px"), ("row", "v", "py")
_X, _Y = ("x", "east", "x_metres"), ("y", "north", "y_metres")
_LATITUDE, _LONGITUDE = ("latitude", "lat"), ("longitude", "lon")


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoints:
    """Points seen in frames, and where they are.

    Attributes
    ----------
    frames : tuple of str
        Names of the files.
    pixels : (N, 2) float64
        Column and row.
    places : (N, 2) float64
        Metres east and north; degrees of latitude and longitude where these were given.
    geodetic : bool
        Whether they were.
    """

    frames: tuple[str, ...]
    pixels: Float64Array
    places: Float64Array
    geodetic: bool = False


def read_control_points(path: Path) -> ControlPoints:
    """Return the points of a CSV file: frame, column, row, and x, y or latitude, longitude.

    Raises
    ------
    InputError
    """
    table = parse_table(path, read_text(path, "control points"))
    if len(table) < 2:
        raise InputError(f"{path} has {len(table)} points; a scale needs two or more")
    pixels = [table.numbers(names, COORDINATE) for names in (_COLUMN, _ROW)]
    if table.has(_LATITUDE):
        places = [
            table.numbers(_LATITUDE, LATITUDE_DEGREES),
            table.numbers(_LONGITUDE, LONGITUDE_DEGREES),
        ]
    else:
        places = [table.numbers(names, COORDINATE) for names in (_X, _Y)]
    return ControlPoints(
        table.words(_FRAME), np.column_stack(pixels), np.column_stack(places), table.has(_LATITUDE)
    )
