"""Types of options' values: paths, bounded numbers, lists of numbers or words, bytes, angles."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    ParamType = click.ParamType[Any]
else:  # click 8.1's takes no parameter
    ParamType = click.ParamType

PATH = click.Path(path_type=Path)

NOT_NEGATIVE = click.FloatRange(min=0)

POSITIVE = click.FloatRange(min=0, min_open=True)

SHARE = click.FloatRange(0, 1)

AT_LEAST_ONE = click.IntRange(min=1)


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
    min_whole : int or None
        Only whole numbers, of at least this value; None: any finite number.
    auto : bool
        Accept the word auto.
    """

    def __init__(
        self,
        name: str,
        *counts: int,
        separator: str = ",",
        groups: int = 1,
        min_whole: int | None = None,
        auto: bool = False,
    ) -> None:
        self.name, self.counts, self.separator, self.groups = name, counts, separator, groups
        self.min_whole, self.auto = min_whole, auto

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
            at_least = "" if self.min_whole is None else f", {self.min_whole} or more each"
            self.fail(f"{value!r} is not of the form {self.name}{at_least}", param, ctx)
        return groups if self.groups > 1 else groups[0]

    def _group(self, text: str) -> tuple[float, ...]:
        """Return the numbers of one group; raises ValueError."""
        whole = self.min_whole is not None
        numbers = tuple(int(part) if whole else float(part) for part in text.split(self.separator))
        low = -math.inf if self.min_whole is None else self.min_whole
        if len(numbers) not in self.counts or not all(
            math.isfinite(number) and number >= low for number in numbers
        ):
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


class Bytes(Value):
    """An amount of memory, such as 500M or 2G."""

    name = "bytes"

    def convert(self, value: Any, param: Any, ctx: Any) -> int:
        """Return the bytes; a usage error shows the form wanted."""
        parts = re.fullmatch(r"(\d+(?:\.\d+)?)([kMGT]?)B?", str(value))
        if parts is None or float(parts[1]) <= 0:
            self.fail(f"{value!r} is no amount such as 500M or 2G", param, ctx)
        factor: int = 1000 ** " kMGT".index(parts[2] or " ")
        return round(float(parts[1]) * factor)

    def text(self, value: int) -> str:
        """Return the bytes in gigabytes."""
        return f"{value / 1e9:g}G"


class Degrees(Value):
    """An angle, given in degrees; the value is in radians."""

    name = "float"

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        """Return radians."""
        return math.radians(click.FLOAT.convert(value, param, ctx))

    def text(self, value: float) -> str:
        """Return radians as degrees."""
        return str(math.degrees(value))
