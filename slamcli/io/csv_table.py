"""CSV tables with a header, whose columns are found by any of their usual names."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import ANGLE, Bounds, quoted
from slamcli.core.errors import InputError

# Endings of the name of a column of angles in degrees.
_DEGREES = ("_degrees", "_deg")
HEADINGS = ("heading", "theta", "yaw")
STAMPS = ("stamp", "timestamp", "time", "t", "seconds")


@dataclass(frozen=True, slots=True)
class Table:
    """The rows of a CSV file.

    Attributes
    ----------
    path : Path
        For messages.
    header : tuple of str
        Lower case.
    rows : tuple of tuple of str
        Each as long as the header.
    lines : tuple of int
        Of the file, one a row.
    """

    path: Path
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def has(self, names: tuple[str, ...]) -> bool:
        """Return whether one of these names heads a column."""
        return any(name in self.header for name in names)

    def words(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return a column's text; raises InputError when none of its names is in the header."""
        for name in names:
            if name in self.header:
                column = self.header.index(name)
                return tuple(row[column].strip() for row in self.rows)
        raise InputError(
            f"{self.path} has no column {names[0]}; its header is {', '.join(self.header)}"
        )

    def numbers(
        self, names: tuple[str, ...], limits: Bounds, *, blank: bool = False
    ) -> Float64Array:
        """Return a column within bounds as (N,) float64; an empty field is nan if `blank` allows.

        Raises
        ------
        InputError
            One line that names the file, the line and the column.
        """
        values = np.full(len(self.rows), np.nan)
        for index, word in enumerate(self.words(names)):
            if blank and word.lower() in {"", "nan"}:
                continue
            try:
                values[index] = float(word)
            except ValueError:
                values[index] = math.nan
            if float(values[index]) not in limits:
                raise InputError(
                    f"{self.path}, line {self.lines[index]}: {names[0]} is {quoted(word)}; "
                    f"{limits} is needed"
                )
        return values

    def angles(
        self, names: tuple[str, ...], limits: Bounds = ANGLE, *, blank: bool = False
    ) -> Float64Array:
        """Return a column of angles as (N,) float64 radians; `name`_degrees is converted."""
        degrees = tuple(name + ending for name in names for ending in _DEGREES)
        if not self.has(names) and self.has(degrees):
            limits = limits.scaled(math.degrees(1.0))
            return np.radians(self.numbers(degrees, limits, blank=blank))
        return self.numbers(names, limits, blank=blank)

    def has_angles(self, names: tuple[str, ...]) -> bool:
        """Return whether one of these names heads a column, in radians or degrees."""
        return self.has(names) or self.has(tuple(n + ending for n in names for ending in _DEGREES))


def parse_table(path: Path, text: str) -> Table:
    """Return the rows of a CSV text whose first line is the header; empty lines are left out."""
    reader = csv.reader(io.StringIO(text.removeprefix("\ufeff")))
    header: tuple[str, ...] = ()
    rows, lines = [], []
    try:
        for words in reader:
            if not any(word.strip() for word in words):
                continue
            if not header:
                header = tuple(word.strip().lower() for word in words)
                continue
            if len(words) > len(header):
                raise InputError(
                    f"{path}, line {reader.line_num}: {len(words)} fields under a header "
                    f"of {len(header)}"
                )
            rows.append((*words, *[""] * (len(header) - len(words))))
            lines.append(reader.line_num)
    except csv.Error as error:
        raise InputError(f"{path}, line {reader.line_num}: not a CSV: {error}") from error
    return Table(path, header, tuple(rows), tuple(lines))
