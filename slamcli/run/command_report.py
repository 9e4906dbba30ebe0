"""The result of a command: lines for a reader, facts for a program, and the exit code."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamcli.core.exit_codes import ExitCode
from slamcli.core.names import readable


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What a command has to say when its work is done.

    Attributes
    ----------
    lines : tuple of str
    facts : mapping of str
        The same for a program, by name with the unit: numbers, texts, paths, and lists of these.
    exit_code : int
    """

    lines: tuple[str, ...]
    facts: Mapping[str, Any]
    exit_code: int = ExitCode.DONE

    @property
    def json(self) -> str:
        """The facts as JSON."""
        return json.dumps(_plain(self.facts), indent=2, ensure_ascii=False)


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: paths as texts, null for what is no number."""
    if isinstance(value, Mapping):
        return {str(key): _plain(member) for key, member in value.items()}
    if isinstance(value, str | Path):
        return readable(str(value))
    if isinstance(value, Sequence):
        return [_plain(member) for member in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value
