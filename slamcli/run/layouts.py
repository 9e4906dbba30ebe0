"""Layouts of line courses, read from TOML files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import Bounds
from slamcli.core.errors import InputError
from slamcli.io.checks import FieldError, check_array, check_matrix, check_number, required
from slamcli.io.toml import read_toml
from slamcli.simulation.config import CourseLayout

_MAX_METRES = 100.0
_MIN_METRES = 1e-4


def read_layout(path: Path) -> CourseLayout:
    """Return the layout of a line course; its file has the keys of `CourseLayout`.

    Raises
    ------
    InputError
        For a file that cannot be read, and for a line that is along neither axis.
    """
    table = read_toml(path, "layout of a course")
    try:
        return _layout(table)
    except FieldError as error:
        raise InputError(f"{path} is no layout of a course: {error}") from error


def _layout(table: dict[str, Any]) -> CourseLayout:
    board = check_matrix(required(table, "board_metres"), "board_metres", (1, 2), _MAX_METRES)[0]
    if board.min() < _MIN_METRES:
        raise FieldError("board_metres", "has a side without length")
    lines = _rows(table, "lines", 4).reshape(-1, 2, 2)
    if np.all(lines[:, 0] != lines[:, 1], axis=1).any():
        raise FieldError("lines", "has a line that is along neither axis")
    squares = _rows(table, "squares", 2)
    return CourseLayout(
        board_metres=(float(board[0]), float(board[1])),
        line_metres=_width(table, "line_metres"),
        square_metres=_width(table, "square_metres"),
        lines=tuple(((float(a[0]), float(a[1])), (float(b[0]), float(b[1]))) for a, b in lines),
        squares=tuple((float(x), float(y)) for x, y in squares),
    )


def _width(table: dict[str, Any], key: str) -> float:
    return check_number(required(table, key), key, Bounds(_MIN_METRES, _MAX_METRES))


def _rows(table: dict[str, Any], key: str, width: int) -> Float64Array:
    """Return (N, width) numbers, none where the table does not have the key."""
    value = table.get(key, [])
    if value == []:
        return np.empty((0, width))
    numbers = check_array(value, key)
    if numbers.ndim < 2 or numbers[0].size != width:
        raise FieldError(key, f"needs {width} numbers each")
    return numbers.reshape(-1, width)
