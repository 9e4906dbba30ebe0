"""Checked reading of single values from tables that come out of a file: JSON, YAML or TOML."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import Bounds, quoted
from slamcli.core.errors import SlamcliError

# Of an array in a text file: the points of a calibration board, with room.
_MAX_ELEMENTS = 10_000


class FieldError(SlamcliError):
    """One key of a table has a value that cannot be used; the reader of the file adds its name.

    Attributes
    ----------
    key : str
    reason : str
        What is wrong with it, as the rest of a sentence that begins with the key.
    """

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(f"{key} {reason}")
        self.key, self.reason = key, reason


def required(section: Mapping[str, Any], key: str) -> Any:
    """Return the value of a key; raises FieldError when the table does not have it."""
    if key not in section:
        raise FieldError(key, "is missing")
    return section[key]


def check_number(value: Any, key: str, limits: Bounds) -> float:
    """Return a number within bounds; raises FieldError for anything else, also nan."""
    if value not in limits:
        raise FieldError(key, f"is {quoted(value)}; {limits} is needed")
    return float(value)


def check_word(value: Any, key: str, words: tuple[Any, ...]) -> Any:
    """Return one of some words; raises FieldError for any other."""
    if value not in words:
        raise FieldError(key, f"is {quoted(value)}, not one of {', '.join(words)}")
    return value


def check_array(value: Any, key: str) -> Float64Array:
    """Return nested lists of finite numbers as a float64 array; raises FieldError."""
    try:
        if isinstance(value, bool | str) or value is None or not _is_small(value):
            raise TypeError
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise FieldError(key, f"is {quoted(value)}; numbers are needed") from error
    if numbers.size == 0 or not np.all(np.isfinite(numbers)):
        raise FieldError(key, "has a number that is not finite, or none at all")
    return numbers


def _is_small(value: Any) -> bool:
    """Return whether nested lists have few elements; the aliases of YAML can stand for billions."""
    left, open_lists = _MAX_ELEMENTS, [value]
    while open_lists and left > 0:
        items = open_lists.pop()
        if isinstance(items, list | tuple):
            left -= len(items)
            open_lists += items[:_MAX_ELEMENTS]
    return left > 0


def check_matrix(value: Any, key: str, shape: tuple[int, int], limit: float) -> Float64Array:
    """Return a matrix of numbers below `limit`, given as rows or as one list; raises FieldError."""
    numbers = check_array(value, key)
    if not np.abs(numbers).max() < limit:
        raise FieldError(key, f"has a number of {limit:g} or more")
    if numbers.size != shape[0] * shape[1]:
        raise FieldError(key, f"has {numbers.size} numbers; {shape[0]} x {shape[1]} are needed")
    return numbers.reshape(shape)
