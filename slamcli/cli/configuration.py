"""--config: options of a command from a TOML file, written by hand or by a run (run.toml).

A value of the command line overrides that of the file, which overrides the default.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import click

from slamcli.cli.options.sections import ESSENTIAL, section
from slamcli.cli.options.values import PATH, Number, Numbers, Whole, Words
from slamcli.core.bounds import quoted
from slamcli.core.config import (
    FeatureOptions,
    FrameSelection,
    MapperOptions,
    MatchOptions,
    NetworkFiles,
    PaintOptions,
    ProductOptions,
)
from slamcli.core.errors import InputError
from slamcli.core.telemetry import TelemetryOptions

# The dataclasses whose fields the tables of run.toml hold.
_GROUPS = {
    "options.mapper": MapperOptions(),
    "options.mapper.features": FeatureOptions(),
    "options.mapper.matching": MatchOptions(),
    "options.telemetry": TelemetryOptions(),
    "options.selection": FrameSelection(),
    "options.networks": NetworkFiles(),
    "options.products": ProductOptions(),
    "options.products.paint": PaintOptions(),
}
# Keys of run.toml whose options are not named after a field.
_RENAMED = {
    "sources": "frames",
    "calibration": "calibration",
    "odometry": "TelemetryFiles_odometry",
    "compass": "TelemetryFiles_compass",
    "gps": "TelemetryFiles_gps",
    "time_offset": "time_offset",
    "options.telemetry.time_offset_seconds": "time_offset",
    "options.max_range_metres": "max_range",
    "options.workers": "workers",
    "options.scheduler": "scheduler",
}
# Neighbours of an angle in degrees that are tried, so that radians come back to the last bit.
_MAX_NEIGHBOURS = 4
# Characters of an unknown key that is compared with the options' names.
_MAX_KEY = 60


def _use(context: click.Context, _option: click.Parameter, path: Path | None) -> None:
    """Take the options of a file as defaults of the command that is being read."""
    if path is not None and not context.resilient_parsing:
        from slamcli.io.toml import read_toml

        tables = read_toml(path, "configuration")
        read = _of_run if "options" in tables and "version" in tables else _by_hand
        known = {p.name: p for p in context.command.params if p.name is not None}
        context.meta[__name__] = path
        values = read(path, tables, known, context.command.name or "")
        context.default_map = {
            name: _text(path, value, known[name]) for name, value in values.items()
        }


def configuration_of(context: click.Context) -> Path | None:
    """Return the file of --config; None without one."""
    path: Path | None = context.meta.get(__name__)
    return path


config_option = section(
    ESSENTIAL,
    click.option(
        "--config",
        type=PATH,
        is_eager=True,
        expose_value=False,
        callback=_use,
        help="Options from a TOML file, or a run.toml. Keys are the names of options; options of "
        "the command line go first.",
    ),
)


def _by_hand(
    path: Path, tables: Mapping[str, Any], known: Mapping[str, click.Parameter], command: str
) -> dict[str, Any]:
    """Return the values by parameter of keys that are options' names, as [command] has them or all.

    Raises
    ------
    InputError
        When a key is no option of the command.
    """
    names = {_key(name): p.name for p in known.values() for name in [*p.opts, p.name or ""]}
    found = {}
    own = tables.get(command)
    for key, value in {**tables, **(own if isinstance(own, Mapping) else {})}.items():
        if isinstance(value, Mapping):
            continue
        name = names.get(_key(key))
        if name is None:
            near = get_close_matches(_key(key)[:_MAX_KEY], names, 1)
            hint = f"; {near[0]} is one" if near else ""
            raise InputError(f"{path}: {quoted(key)} is no option of slam {command}{hint}")
        found[name] = value
    return found


def _key(name: str) -> str:
    return name.lstrip("-").replace("_", "-").replace("meters", "metres")


def _of_run(
    path: Path, tables: Mapping[str, Any], known: Mapping[str, click.Parameter], _command: str
) -> dict[str, Any]:
    """Return the values by parameter of a run.toml, as far as the command has such options.

    Raises
    ------
    InputError
        When it has a value that no option can give.
    """
    found: dict[str, Any] = {}
    try:
        rows = list(_rows(tables))
    except (AttributeError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: an angle or datum is not as a run writes it: {error}") from error
    for section_name, key, value in rows:
        place = f"{section_name}.{key}".lstrip(".")
        group = _GROUPS.get(section_name)
        name = _RENAMED.get(place, f"{type(group).__name__ if group else 'StitchOptions'}_{key}")
        if name in known:
            found.setdefault(name, value)
        elif group is not None and value != _plain(getattr(group, key, value)):
            raise InputError(f"{path}: no option gives {place} = {quoted(value)}")
    if "time_offset" in tables and "time_offset" in known:
        found["time_offset"] = tables["time_offset"]
    # What is None is not in the file; of options with another default it has a word.
    lever = "TelemetryOptions_lever_arm_metres"
    options = tables["options"]
    if lever in known and isinstance(options, Mapping) and "telemetry" in options:
        found.setdefault(lever, "auto")
    return found


def _rows(tables: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str, Any]]:
    """Yield (section, key, value) of the inputs and options of a run.toml."""
    for key, value in tables.items():
        place = f"{prefix}.{key}".lstrip(".")
        if place == "options.products.datum":
            heading = _degrees(value.get("east_heading_radians", 0.0))
            place_on_earth = [value["latitude_degrees"], value["longitude_degrees"], heading]
            yield "options.products", "datum", place_on_earth
        elif isinstance(value, Mapping) and place.split(".")[0] == "options":
            yield from _rows(value, place)
        elif place == "options.products.turn_radians":
            yield prefix, key, _degrees(value)
        elif not isinstance(value, Mapping) and (prefix or place in _RENAMED):
            yield prefix, key, value


def _degrees(radians: float) -> float:
    """Return the degrees that `math.radians` turns into these radians, to the last bit."""
    near = [math.degrees(radians)]
    for end in (math.inf, -math.inf):
        near += [near[0]]
        for _ in range(_MAX_NEIGHBOURS):
            near.append(math.nextafter(near[-1], end))
    return next((degrees for degrees in near if math.radians(degrees) == radians), near[0])


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _text(path: Path, value: Any, parameter: click.Parameter) -> Any:
    """Return a value of the file as the command line would give it.

    Raises
    ------
    InputError
        When it is a table, a time, or several values where the option takes one.
    """
    several = parameter.nargs != 1 or getattr(parameter, "multiple", False)
    if isinstance(value, list) and isinstance(parameter.type, Numbers | Words):
        separator = getattr(parameter.type, "separator", ",")
        return separator.join(str(part) for part in value)
    if isinstance(value, list) and several and all(isinstance(part, str) for part in value):
        return value
    if not isinstance(value, str | int | float):
        name = _key(max(parameter.opts, key=len))
        raise InputError(f"{path}: {quoted(value)} is no value of {name}")
    if isinstance(value, bool) and getattr(parameter, "is_flag", False):
        return value
    if isinstance(parameter.type, Number | Whole) and not isinstance(value, bool):
        return value
    return [str(value)] if several else str(value)
