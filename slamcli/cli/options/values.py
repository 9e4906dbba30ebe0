"""What an option's value may be: a path, a number within bounds, a list of words or of numbers."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)

NOT_NEGATIVE = click.FloatRange(min=0)

POSITIVE = click.FloatRange(min=0, min_open=True)


class Size(click.ParamType[tuple[int, int]]):
    """Width and height in pixels, such as 640x480."""

    name = "WxH"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[int, int]:
        """Return (width, height); a usage error says what form is wanted."""
        match = re.fullmatch(r"(\d+)x(\d+)", str(value))
        if match is None or min(int(match[1]), int(match[2])) < 64:
            self.fail(f"{value!r} is not of the form 640x480, 64 or more each", param, ctx)
        return int(match[1]), int(match[2])


class Choices(click.ParamType[tuple[str, ...]]):
    """Any of some words, separated by commas."""

    def __init__(self, words: tuple[str, ...]) -> None:
        self.words = words
        self.name = ",".join(words)

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, ...]:
        """Return the words chosen, in their own order; a usage error says which there are."""
        chosen = {word.strip() for word in value.split(",")} if isinstance(value, str) else value
        unknown = sorted(set(chosen) - {*self.words, ""})
        if unknown:
            self.fail(f"{unknown[0]!r} is none of {', '.join(self.words)}", param, ctx)
        return tuple(word for word in self.words if word in chosen)


class Reals(click.ParamType[tuple[float, ...]]):
    """So many numbers, separated by commas."""

    def __init__(self, counts: tuple[int, ...], name: str) -> None:
        self.counts, self.name = counts, name

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...]:
        """Return the numbers; a usage error says what form is wanted."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in value.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) not in self.counts or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not of the form {self.name}", param, ctx)
        return numbers


class Measured(click.ParamType["tuple[float, ...] | None"]):
    """So many numbers, separated by commas, or the word auto: None."""

    def __init__(self, count: int, name: str) -> None:
        self.count, self.name = count, name

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[float, ...] | None:
        """Return the numbers; a usage error says what form is wanted."""
        if value == "auto":
            return None
        try:
            numbers = tuple(map(float, value.split(",")))
        except ValueError:
            numbers = ()
        if len(numbers) != self.count or not all(map(math.isfinite, numbers)):
            self.fail(f"{value!r} is not of the form {self.name}", param, ctx)
        return numbers


class Bytes(click.ParamType[int]):
    """An amount of memory, such as 500M or 2G."""

    name = "bytes"

    def convert(self, value: Any, param: Any, ctx: Any) -> int:
        """Return the bytes; a usage error says what form is wanted."""
        if isinstance(value, int):
            return value
        parts = re.fullmatch(r"(\d+(?:\.\d+)?)([kMGT]?)B?", value)
        if parts is None or float(parts[1]) <= 0:
            self.fail(f"{value!r} is no amount such as 500M or 2G", param, ctx)
        factor: int = 1000 ** " kMGT".index(parts[2] or " ")
        return round(float(parts[1]) * factor)
