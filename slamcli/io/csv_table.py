"""CSV tables with a header, whose columns are found by any of their usual names."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.bounds import ANGLE, Bounds, quoted
from slamcli.core.errors import InputError

# Endings of the name of a column of angles in degrees.
_DEGREES = ("_degrees", "_deg")
HEADINGS = ("heading", "theta", "yaw", "pose.orientation.yaw")
_ROSTOPIC_TIME = "%time"
# As loggers call them: rostopic, PlotJuggler, phones' sensor loggers, autopilots.
STAMPS = (
    *("stamp", "header.stamp", "timestamp", "time", "t", "seconds", "unix_time", "epoch"),
    *("datetime", "date_time", "utc", "utc_time", "time_utc", "gps_time", "seconds_elapsed"),
    *("elapsed", _ROSTOPIC_TIME, "__time"),
)
# A time in two columns: whole seconds, and nanoseconds.
_WHOLE_SECONDS = ("header.stamp.sec", "header.stamp.secs", "stamp.sec", "stamp.secs", "sec", "secs")
_NANOSECONDS = (
    *("header.stamp.nanosec", "header.stamp.nsecs", "header.stamp.nsec"),
    *("stamp.nanosec", "stamp.nsecs", "stamp.nsec", "nanosec", "nsecs", "nsec"),
)
# What separates the fields, else spaces; where it is no comma, a comma may be the decimal point.
_DELIMITERS = ",;\t"
# Of the day alone, beside one of the time of day; a day whose parts no ISO hyphens separate.
_DAYS = ("date",)
_CLOCK = re.compile(r"\d{1,2}:\d\d(:|$)")
_DAY = re.compile(r"(\d{4})[/.:](\d\d)[/.:](\d\d)(?!\d)")
_NUMBER = re.compile(r"[-+]?\.?\d")
# Units in brackets in the name of a column, as endings of it; metres, seconds, radians need none.
_UNITS = {"deg": "_deg", "degrees": "_deg", "°": "_deg", "µs": "_us"}
_METRES = {"": 1.0, "_m": 1.0, "_metres": 1.0, "_meters": 1.0, "_cm": 0.01, "_mm": 0.001}
_PLAIN_UNITS = frozenset({"m", "s", "sec", "rad"})
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")
_SECONDS = {"": None, "_s": 1, "_sec": 1, "_ms": 10**3, "_us": 10**6, "_ns": 10**9}
# From these on a number counts parts of a second since 1970: as seconds it would be past 5000.
# As exact as it is written; exponents would make numbers of any length.
_DECIMAL = re.compile(r"[-+]?\d{1,30}(?:\.\d{0,30})?")
_PARTS = ((10**17, 10**9), (10**14, 10**6), (10**11, 10**3))


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
    decimal_comma : bool
        Whether a comma in a number is its decimal point.
    """

    path: Path
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]
    decimal_comma: bool = False

    def __len__(self) -> int:
        return len(self.rows)

    def has(self, names: tuple[str, ...]) -> bool:
        """Return whether one of these names heads a column."""
        return self._column(names) is not None

    def words(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return a column's text; raises InputError when none of its names is in the header."""
        column = self._column(names)
        if column is None:
            raise InputError(
                f"{self.path} has no column {names[0]}; its header is {', '.join(self.header)}"
            )
        return tuple(row[column].strip() for row in self.rows)

    def _column(self, names: tuple[str, ...]) -> int | None:
        """Return which column has one of these names; those with a dot also end another name.

        So `pose.x` and `.x` are found as that of a topic, `odom.pose.x`.

        Raises
        ------
        InputError
            When several topics have such a column.
        """
        column = next((self.header.index(name) for name in names if name in self.header), None)
        if column is not None:
            return column
        endings = tuple(f".{name.lstrip('.')}" for name in names if "." in name)
        found = [one for one in self.header if one.endswith(endings)] if endings else []
        if len(found) > 1:
            raise InputError(f"{self.path} has several columns {names[0]}: {', '.join(found)}")
        return self.header.index(found[0]) if found else None

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
                values[index] = float(self._plain(word))
            except ValueError:
                values[index] = math.nan
            if float(values[index]) not in limits:
                raise InputError(
                    f"{self.path}, line {self.lines[index]}: {names[0]} is {quoted(word)}; "
                    f"{limits} is needed"
                )
        return values

    def lengths(
        self, names: tuple[str, ...], limits: Bounds, *, blank: bool = False
    ) -> Float64Array:
        """Return a column of lengths as (N,) float64 metres; `name`_mm and `name`_cm are converted.

        Raises
        ------
        InputError
            As `numbers`.
        """
        units = {tuple(name + ending for name in names): one for ending, one in _METRES.items()}
        found = next((named for named in units if self.has(named)), names)
        metres = units.get(found, 1.0)
        values = self.numbers(found, limits.scaled(1.0 / metres), blank=blank)
        return values if metres == 1.0 else metres * values

    def stamps(self, limits: Bounds, *, blank: bool = False) -> Float64Array | None:
        """Return the stamps as (N,) float64 seconds; None without a column of them.

        Numbers are of the unit that the column's name ends in, else by their size seconds, or
        milliseconds, microseconds or nanoseconds since 1970; texts are times of ISO 8601, in UTC
        unless they say otherwise, whose day may be in a column of its own.
        """
        names = {name + ending: unit for ending, unit in _SECONDS.items() for name in STAMPS}
        found = next((name for name in names if self.has((name,))), None)
        if found is None:
            return self._stamps_in_two(limits)
        words = [self._plain(word) for word in self.words((found,))]
        if self.has(_DAYS) and all(map(_CLOCK.match, words)):
            days = self.words(_DAYS)
            words = [f"{day} {word:0>8}" for day, word in zip(days, words, strict=True)]
        seconds = [_seconds(word) for word in words]
        known = [abs(value) for value in seconds if value is not None]
        unit = names[found]
        # An exponent has lost the digits of a time.
        if unit is None and all(map(_DECIMAL.fullmatch, words)):
            middle = sorted(known)[len(known) // 2] if known else 0
            unit = next((parts for least, parts in _PARTS if middle >= least), 1)
        unit = unit or 1
        values = np.array([math.nan if s is None else float(s / unit) for s in seconds])
        for index, word in enumerate(words):
            empty = blank and word.lower() in {"", "nan"}
            if not empty and float(values[index]) not in limits:
                raise InputError(
                    f"{self.path}, line {self.lines[index]}: {found} is {quoted(word)}; "
                    f"{limits} or a time such as 2024-05-06T12:00:00Z is needed"
                )
        return values

    def _stamps_in_two(self, limits: Bounds) -> Float64Array | None:
        """Return stamps that are whole seconds in one column and nanoseconds in another."""
        if not self.has(_WHOLE_SECONDS) or not self.has(_NANOSECONDS):
            return None
        whole = self.numbers(_WHOLE_SECONDS, limits)
        return whole + 1e-9 * self.numbers(_NANOSECONDS, Bounds(0.0, 1e9))

    def _plain(self, word: str) -> str:
        """Return a number with a decimal point."""
        return word.replace(",", ".") if self.decimal_comma and word.count(",") == 1 else word

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
    """Return the rows of a CSV text whose first line is the header; empty lines are left out.

    Comments, which begin with #, may come before it; the last one is the header where numbers
    follow. Fields are separated by what the header has most of, commas, semicolons or tabs, else
    by spaces.
    """
    text_lines = _without_comments(io.StringIO(text.removeprefix("\ufeff")).readlines())
    first = next((line for line in text_lines if line.strip()), "")
    delimiter = max(_DELIMITERS, key=first.count)
    if delimiter not in first:
        delimiter, text_lines = " ", [" ".join(line.split()) for line in text_lines]
    reader = csv.reader(text_lines, delimiter=delimiter)
    header: tuple[str, ...] = ()
    rows, lines = [], []
    try:
        for words in reader:
            if not any(word.strip() for word in words):
                continue
            if not header:
                header = _header(words)
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
    return Table(path, header, tuple(rows), tuple(lines), delimiter != ",")


def _without_comments(lines: list[str]) -> list[str]:
    """Return lines whose comments before the table are empty, all but one that is its header."""
    begin = next(
        (n for n, line in enumerate(lines) if line.strip() and not line.startswith("#")), 0
    )
    comments = [number for number in range(begin) if lines[number].startswith("#")]
    before = [""] * begin
    if comments and _NUMBER.match(lines[begin].lstrip()):
        before[comments[-1]] = lines[comments[-1]].lstrip("# ")
    return before + lines[begin:]


def _header(words: Sequence[str]) -> tuple[str, ...]:
    """Return the names of columns.

    ``rostopic echo -p``, known by its %time, writes times in nanoseconds, also those of a
    simulation, which begin at 0.
    """
    names = tuple(_column_name(word) for word in words)
    if _ROSTOPIC_TIME not in names:
        return names
    return tuple(f"{n}_ns" if n == _ROSTOPIC_TIME or n.endswith("stamp") else n for n in names)


def _column_name(word: str) -> str:
    """Return a name in lower case, without ROS's prefix, and its unit as the names here have it."""
    name = word.strip().lower().replace("/", ".").lstrip(".").removeprefix("field.")
    match = _UNIT.search(name)
    if match is not None and match.start() > 0:
        unit = match[1]
        ending = "" if unit in _PLAIN_UNITS else _UNITS.get(unit, f"_{unit}")
        name = name[: match.start()] + ending
    return name.replace(" ", "_")


def _seconds(word: str) -> Fraction | None:
    """Return a number as it stands, or the seconds since 1970 of a time; None for what is none."""
    if _DECIMAL.fullmatch(word):
        return Fraction(word)
    try:
        return Fraction(float(word))
    except (ValueError, OverflowError):  # nan and infinity among them
        pass
    try:
        moment = datetime.fromisoformat(_DAY.sub(r"\1-\2-\3", word, count=1))
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        return Fraction(moment.timestamp())
    except (ValueError, OverflowError):
        return None
