"""Every command with its work replaced by a spy: what an option makes of the call."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import click
import pytest

from slamcli.cli.main import COMMANDS, main

LOADED = {
    name: command
    for name in COMMANDS
    if (command := main.get_command(click.Context(main), name)) is not None
}
# What the commands are called with besides the option; files need only exist.
ARGUMENTS = {
    "stitch": ["frames"],
    "live": ["0"],
    "locate": ["frames", "frames"],
    "render": ["frames"],
    "view": ["frames"],
    "warp": ["frames"],
    "extract": ["frames"],
    "detect": ["frames"],
    "match": ["frames/a.png", "frames/b.png"],
    "evaluate": ["frames/a.png", "frames/b.png"],
    "calibrate": ["frames/a.png"],
    "simulate": ["out"],
}
WORK = [
    *[(f"slamcli.run.{name}", name) for name in COMMANDS],
    ("slamcli.run.stitch.dry_run", "forecast"),
    ("slamcli.run.self_calibration", "calibrate_by_frames"),
]


class Report(list[str]):
    """What any function of `slamcli.run` may return."""

    def __init__(self) -> None:
        super().__init__(["a line"])
        self.lines, self.json, self.exit_code = ["a line"], "{}", 0

    def serve(self) -> None:
        """Show nothing."""


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, list[Any]]]:
    """The calls of functions of `slamcli.run`, which do nothing; functions given are left out."""
    found: list[tuple[str, list[Any]]] = []

    def spy(name: str) -> Any:
        def work(*given: Any, **named: Any) -> Report:
            values = [*given, *(named[key] for key in sorted(named))]
            found.append((name, [value for value in values if not callable(value)]))
            return Report()

        return work

    for module, name in WORK:
        monkeypatch.setattr(importlib.import_module(module), name, spy(name))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()
    for file in "abc":
        (tmp_path / "frames" / f"{file}.png").write_bytes(b"")
    return found


def flag_of(parameter: click.Option) -> str:
    return max(parameter.opts, key=len)
