"""The header of a map file: how features were found and where frames are, each value checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, astuple, fields, replace
from pathlib import Path
from typing import Any, get_args

from slamcli.core.bounds import (
    ANGLE,
    FEATURES,
    HERTZ,
    LATITUDE_DEGREES,
    LONGITUDE_DEGREES,
    SECONDS_OR_ZERO,
    TIME_STEP,
    quoted,
)
from slamcli.core.config import Datum, FeatureMethod, FeatureOptions, FrameSelection
from slamcli.core.errors import MapError
from slamcli.io.checks import check_number, check_word

_MAX_PATH_CHARACTERS = 32_767
_SELECTION_LIMITS = {
    "every_seconds": TIME_STEP,
    "frames_per_second": HERTZ,
    "from_seconds": SECONDS_OR_ZERO,
    "to_seconds": SECONDS_OR_ZERO,
}


def features_header(options: FeatureOptions) -> dict[str, Any]:
    """Return feature options as JSON has them; a learned method's network is not stored."""
    return asdict(replace(options, network=None))


def parse_features(section: Any) -> FeatureOptions:
    """Return feature options of which every value is of its kind and range.

    Raises
    ------
    FieldError, MapError
    """
    known = {field.name: getattr(FeatureOptions(), field.name) for field in fields(FeatureOptions)}
    if set(section) != set(known):
        raise MapError("its feature options are not those of this version")
    for name, default in known.items():
        value = section[name]
        if type(value) is not type(default) and not (
            isinstance(default, float) and type(value) is int
        ):
            raise MapError(f"its feature option {name} is {quoted(value)}")
        if name in FEATURES:
            check_number(value, name, FEATURES[name])
    check_word(section["method"], "method", get_args(FeatureMethod))
    return FeatureOptions(**section)


def sources_header(sources: Sequence[Path]) -> list[str]:
    """Return the absolute paths of folders and files of frames."""
    return [str(source.absolute()) for source in sources]


def parse_sources(section: Any) -> tuple[Path, ...]:
    """Return the paths of folders and files of frames; raises MapError."""
    if not isinstance(section, list) or not all(
        isinstance(text, str) and 1 <= len(text) <= _MAX_PATH_CHARACTERS and "\0" not in text
        for text in section
    ):
        raise MapError("its sources are not a list of paths")
    return tuple(map(Path, section))


def selection_header(selection: FrameSelection) -> dict[str, Any]:
    """Return a selection of frames as JSON has it: what was given."""
    return {name: value for name, value in asdict(selection).items() if value not in {None, ""}}


def parse_selection(section: Any) -> FrameSelection:
    """Return a selection of frames of which every value is in its range.

    Raises
    ------
    FieldError, InputError, MapError
    """
    if not isinstance(section, dict) or not set(section) <= {*_SELECTION_LIMITS, "topic"}:
        raise MapError("its selection of frames is not one of this version")
    topic = section.get("topic", "")
    if not isinstance(topic, str) or len(topic) > _MAX_PATH_CHARACTERS:
        raise MapError("its selection of frames is not one of this version")
    numbers = {name: value for name, value in section.items() if name != "topic"}
    checked = {n: check_number(v, n, _SELECTION_LIMITS[n]) for n, v in numbers.items()}
    return FrameSelection(**checked, topic=topic)


def datums_header(datums: Sequence[tuple[int, Datum]]) -> list[list[float]]:
    """Return where fragments lie on Earth: fragment, latitude, longitude, heading."""
    return [[number, *astuple(datum)] for number, datum in datums]


def parse_datums(section: Any) -> tuple[tuple[int, Datum], ...]:
    """Return where fragments lie on Earth, each number in its range.

    Raises
    ------
    FieldError, MapError
    """
    found = []
    for row in section if isinstance(section, list) else [section]:
        if not isinstance(row, list) or len(row) != 4 or type(row[0]) is not int:
            raise MapError("its places on Earth are not those of fragments")
        limits = (LATITUDE_DEGREES, LONGITUDE_DEGREES, ANGLE)
        names = ("latitude", "longitude", "heading")
        numbers = map(check_number, row[1:], names, limits)
        found.append((row[0], Datum(*numbers)))
    return tuple(found)
