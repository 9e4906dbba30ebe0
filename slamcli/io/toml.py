"""TOML: run.toml, with the options of a run and its counts as flat tables; configurations."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamcli.core.errors import InputError
from slamcli.core.names import readable
from slamcli.io.files import read_text, write_text

# A key of many parts, of which tomllib takes time by their square.
_DEEP_KEY = re.compile(r"(?<![\w\"'-])(?:[\w\"'-]++[ \t]*+\.[ \t]*+){100}")

Scalar = str | int | float | bool | tuple[str, ...] | tuple[float, ...] | None


def flatten(options: object, prefix: str = "") -> list[tuple[str, str, Scalar]]:
    """Return (section, key, value) for every field of nested dataclasses."""
    assert dataclasses.is_dataclass(options)
    rows: list[tuple[str, str, Scalar]] = []
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            section = f"{prefix}.{field.name}" if prefix else field.name
            rows += flatten(value, section)
        else:
            rows.append((prefix, field.name, value))
    return rows


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a file; raises InputError that names it and says what it is."""
    text = read_text(path, what)
    if _DEEP_KEY.search(text):
        raise InputError(f"{path} is no TOML file: it is nested too deeply")
    try:
        return tomllib.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is no TOML file: {error}") from error
    except RecursionError as error:
        raise InputError(f"{path} is no TOML file: it is nested too deeply") from error


def write_toml(path: Path, sections: Mapping[str, Mapping[str, Scalar]]) -> None:
    """Write flat TOML tables; a key whose value is None is left out, as TOML has no null."""
    blocks = []
    for section, values in sections.items():
        lines = [f"[{section}]"] if section else []
        lines += [
            f"{key} = {_literal(value)}" for key, value in values.items() if value is not None
        ]
        blocks.append("\n".join(lines))
    write_text(path, "\n\n".join(blocks) + "\n")


def _literal(value: Scalar) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, tuple):
        return f"[{', '.join(map(_literal, value))}]"
    # Anything else, such as a path or a network, is written as its text.
    return json.dumps(readable(str(value)), ensure_ascii=False)
