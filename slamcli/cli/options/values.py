"""Types of options' values: paths, bounded numbers, lists of numbers or words, bytes, angles."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.core import bounds
from slamcli.core.bounds import Bounds, quoted

if TYPE_CHECKING:
    ParamType = click.ParamType[Any]
else:  # click 8.1's takes no parameter
    ParamType = click.ParamType

PATH = click.Path(path_type=Path)

# Less than any picture takes, and more than any machine has.
_MIN_BYTES, _MAX_BYTES = 10**6, 10**15


class Number(click.FloatRange):
    """A finite number within bounds; click's own range takes nan."""

    def __init__(self, limits: Bounds) -> None:
        super().__init__(limits.low, limits.high, limits.open_low, limits.open_high)
        self.limits = limits

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return the number; a usage error shows the bounds."""
        try:
            number = float(value)
        except (ValueError, OverflowError):
            self.fail(f"{quoted(value)} is not a number", param, ctx)
        if number not in self.limits:
            self.fail(f"{quoted(value)} is not {self.limits}", param, ctx)
        return number

    def _describe_range(self) -> str:
        return described(self.limits)


class Whole(click.IntRange):
    """A whole number within bounds."""

    def __init__(self, limits: Bounds) -> None:
        super().__init__(int(limits.low), int(limits.high))
        self.limits = limits

    def convert(self, value: Any, param: Any, ctx: Any) -> int:
        """Return the number; a usage error shows the bounds."""
        try:
            number = int(value)
        except (ValueError, OverflowError):
            self.fail(f"{quoted(value)} is not {self.limits}", param, ctx)
        if number not in self.limits:
            self.fail(f"{quoted(value)} is not {self.limits}", param, ctx)
        return number

    def _describe_range(self) -> str:
        return described(self.limits)


def described(limits: Bounds) -> str:
    """Return bounds as the help of an option shows them."""
    low, high = "<" if limits.open_low else "<=", "<" if limits.open_high else "<="
    return f"{limits.low:g}{low}x{high}{limits.high:g}"


NOT_NEGATIVE = Number(bounds.LENGTH_OR_ZERO)

POSITIVE = Number(bounds.LENGTH)

SHARE = Number(bounds.SHARE)

AT_LEAST_ONE = Whole(bounds.COUNT)


class Value(ParamType):
    """A value with a written form of its own."""

    def text(self, value: Any) -> str | None:
        """Return a default as `convert` takes it; None is no default."""
        raise NotImplementedError


class Numbers(Value):
    """Numbers with a separator between them, such as 640x480, or several such groups.

    The value is a tuple, a tuple of tuples for several groups, and None for the word auto.

    Parameters
    ----------
    name : str
        The form wanted, as help and usage errors show it.
    counts : int
        How many numbers there may be in a group.
    separator : str
    groups : int
        Separated by white space.
    limits : Bounds
        Of each number.
    auto : bool
        Accept the word auto.
    """

    def __init__(
        self,
        name: str,
        *counts: int,
        separator: str = ",",
        groups: int = 1,
        limits: Bounds = bounds.COORDINATE,
        auto: bool = False,
    ) -> None:
        self.name, self.counts, self.separator, self.groups = name, counts, separator, groups
        self.limits, self.auto = limits, auto

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the numbers; a usage error shows the form wanted."""
        if not isinstance(value, str):
            return value
        if self.auto and value == "auto":
            return None
        parts = value.split() if self.groups > 1 else [value]
        try:
            groups = tuple(self._group(part) for part in parts)
        except ValueError:
            groups = ()
        if len(groups) != self.groups:
            self.fail(
                f"{quoted(value)} is not of the form {self.name}, each {self.limits}", param, ctx
            )
        return groups if self.groups > 1 else groups[0]

    def _group(self, text: str) -> tuple[float, ...]:
        """Return the numbers of one group; raises ValueError."""
        kind = int if self.limits.whole else float
        numbers = tuple(kind(part) for part in text.split(self.separator))
        if len(numbers) not in self.counts or any(n not in self.limits for n in numbers):
            raise ValueError(text)
        return numbers

    def text(self, value: tuple[float, ...] | None) -> str | None:
        """Return one group as `convert` takes it."""
        if value is None:
            return "auto" if self.auto else None
        return self.separator.join(f"{number:g}" for number in value)


class Words(Value):
    """Any of some words, separated by commas."""

    def __init__(self, *words: str) -> None:
        self.words = words
        self.name = ",".join(words)

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        """Return the words chosen, in their own order; a usage error lists all."""
        chosen = {word.strip() for word in value.split(",")} if isinstance(value, str) else value
        unknown = sorted(set(chosen) - {*self.words, ""})
        if unknown:
            self.fail(f"{unknown[0]!r} is none of {', '.join(self.words)}", param, ctx)
        return tuple(word for word in self.words if word in chosen)

    def text(self, value: tuple[str, ...]) -> str:
        """Return the words as `convert` takes them."""
        return ",".join(value)


class Switch(Value):
    """Whether something is done: auto, always or never; of a flag without a value, always.

    A file may say true or false.
    """

    name = "auto|always|never"
    words = ("auto", "always", "never")

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Return the word."""
        word = {"true": "always", "false": "never"}.get(str(value).lower(), str(value))
        if word not in self.words:
            self.fail(f"{value!r} is none of {', '.join(self.words)}", param, ctx)
        return word

    def text(self, value: Any) -> str:
        """Return the word."""
        return str(value)

    def spelled_out(self, flag: str, arguments: list[str]) -> list[str]:
        """Return the arguments of a command with the flag's value, or `--no-` before it, as words.

        So the argument after a flag without a value is not taken for one.
        """
        spelled = []
        for number, argument in enumerate(arguments):
            if argument == flag and not set(arguments[number + 1 : number + 2]) & set(self.words):
                spelled.append(f"{flag}=always")
            elif argument == f"--no-{flag.removeprefix('--')}":
                spelled.append(f"{flag}=never")
            else:
                spelled.append(argument)
        return spelled


class Bar(Value):
    """A scale bar: a frame, two of its pixels, and their distance in metres."""

    name = "frame,column,row,column,row,metres"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the scale bar."""
        from slamcli.run.stitch.options import ScaleBar

        if isinstance(value, ScaleBar):
            return value
        frame, *words = value.rsplit(",", 5)
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if len(numbers) != 5 or not all(map(math.isfinite, numbers)) or not numbers[4] > 0.0:
            self.fail(f"{quoted(value)} is not {self.name}", param, ctx)
        if numbers[:2] == numbers[2:4]:
            self.fail(f"{quoted(value)}: the two pixels are one", param, ctx)
        first, second = (numbers[0], numbers[1]), (numbers[2], numbers[3])
        return ScaleBar(frame, first, second, numbers[4])

    def text(self, value: Any) -> str:
        """Return the bar as `convert` takes it."""
        ends = ",".join(f"{number:g}" for number in (*value.first, *value.second, value.metres))
        return f"{value.frame},{ends}"


class Gamma(Value):
    """How a picture encodes light: srgb, linear, or the exponent of a power."""

    name = "srgb|linear|number"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the word, or the exponent."""
        if value in ("srgb", "linear"):
            return value
        exponent: float = click.FLOAT.convert(value, param, ctx)
        if not 0.2 <= exponent <= 5.0:
            self.fail(f"{value!r} is neither srgb, linear nor a number such as 2.2", param, ctx)
        return exponent

    def text(self, value: Any) -> str:
        """Return the word, or the exponent."""
        return str(value)


class CoordinateSystem(Value):
    """A coordinate system by its EPSG code, or auto."""

    name = "auto|EPSG:n"

    def convert(self, value: Any, param: Any, ctx: Any) -> str:
        """Return the word, or the code; a usage error shows the form wanted."""
        text = str(value).upper()
        if text == "AUTO" or not value:
            return text.lower()
        if not re.fullmatch(r"EPSG:\d{3,6}", text):
            self.fail(f"{quoted(value)} is neither auto nor a code such as EPSG:32632", param, ctx)
        return text

    def text(self, value: Any) -> str:
        """Return the word, or the code."""
        return str(value)


class Bytes(Value):
    """An amount of memory, such as 500M or 2G."""

    name = "bytes"

    def convert(self, value: Any, param: Any, ctx: Any) -> int:
        """Return the bytes; a usage error shows the form wanted."""
        parts = re.fullmatch(r"(\d{1,15}(?:\.\d{1,15})?)([kMGT]?)B?", str(value), re.ASCII)
        factor: int = 0 if parts is None else 1000 ** " kMGT".index(parts[2] or " ")
        count = 0 if parts is None else round(float(parts[1]) * factor)
        if not _MIN_BYTES <= count <= _MAX_BYTES:
            self.fail(f"{quoted(value)} is no amount such as 500M or 2G", param, ctx)
        return count

    def text(self, value: int) -> str:
        """Return the bytes in gigabytes."""
        return f"{value / 1e9:g}G"


class Degrees(Value):
    """An angle within some turns, given in degrees; the value is in radians."""

    name = "float"
    limits = Bounds(-3600.0, 3600.0)

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return radians."""
        return math.radians(Number(self.limits).convert(value, param, ctx))

    def text(self, value: float) -> str:
        """Return radians as degrees."""
        return str(math.degrees(value))
