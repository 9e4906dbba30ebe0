"""Checked reading of single values from tables that come out of a file: JSON, YAML or TOML."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.errors import SlamcliError


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


def check_number(value: Any, key: str, low: float, high: float) -> float:
    """Return a number from `low` to `high`; raises FieldError for anything else, also nan."""
    if type(value) not in {int, float} or not low <= value <= high:
        raise FieldError(key, f"is {value!r}; a number from {low:g} to {high:g} is needed")
    return float(value)


def check_word(value: Any, key: str, words: tuple[Any, ...]) -> Any:
    """Return one of some words; raises FieldError for any other."""
    if value not in words:
        raise FieldError(key, f"is {value!r}, not one of {', '.join(words)}")
    return value


def check_array(value: Any, key: str) -> Float64Array:
    """Return nested lists of finite numbers as a float64 array; raises FieldError."""
    try:
        if isinstance(value, bool | str) or value is None:
            raise TypeError
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise FieldError(key, f"is {value!r}; numbers are needed") from error
    if numbers.size == 0 or not np.all(np.isfinite(numbers)):
        raise FieldError(key, "has a number that is not finite, or none at all")
    return numbers


def check_matrix(value: Any, key: str, shape: tuple[int, int], limit: float) -> Float64Array:
    """Return a matrix of numbers below `limit`, given as rows or as one list; raises FieldError."""
    numbers = check_array(value, key)
    if not np.abs(numbers).max() < limit:
        raise FieldError(key, f"has a number of {limit:g} or more")
    if numbers.size != shape[0] * shape[1]:
        raise FieldError(key, f"has {numbers.size} numbers; {shape[0]} x {shape[1]} are needed")
    return numbers.reshape(shape)
