"""No option of the command line is without effect: each one reaches what does the work."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from slamcli.cli.main import main

# What the commands are called with besides the option; files need only be there.
ARGUMENTS = {
    "stitch": ["frames"],
    "locate": ["frames", "frames"],
    "render": ["frames"],
    "warp": ["frames"],
    "detect": ["frames"],
    "match": ["frames/a.png", "frames/b.png"],
    "evaluate": ["frames/a.png", "frames/b.png"],
    "calibrate": ["frames/a.png"],
    "simulate": ["out"],
}
# Those that choose what is done, or how it is told, and not what is asked of it.
APART = {"help", "dry_run", "refine", "as_json"}
# These are of `slam calibrate --refine` alone.
REFINING = {("calibrate", "calibration"), ("calibrate", "workers")}
TEXTS = {
    "formats": "geotiff",
    "layers": "views",
    "export": "tum",
    "size": "320x240",
    "crop": "0,0,1,1",
    "datum": "1,2",
    "corners": "1,2 30,2 30,40 1,40",
    "memory": "2G",
    "time_offset": "0.5",
    "lever_arm": "1,2",
    "scheduler": "tcp://here:1",
    "chessboard": "8x6",
    "network_size": "640x480",
    "first_level": "1",
}


def other_value(option: click.Option) -> list[str]:
    """Return the option as given with a value that is not its default."""
    name, kind = option.opts[0], option.type
    if option.is_flag or option.secondary_opts:
        return [option.secondary_opts[0] if option.default is True else name]
    if option.name in TEXTS:
        return [name, TEXTS[option.name]]
    if isinstance(kind, click.Choice):
        return [name, next(c for c in kind.choices if c != option.default)]
    if isinstance(kind, click.IntRange | click.FloatRange):
        low = 1 if kind.min is None else kind.min
        high = low + 8 if kind.max is None else kind.max
        value: float = next(
            v for share in (0.5, 0.25, 0.75) if (v := low + share * (high - low)) != option.default
        )
        return [name, str(int(value) if isinstance(kind, click.IntRange) else value)]
    if kind in (click.FLOAT, click.INT):
        return [name, "3"]
    return [name, "frames/c.png"]


def cases() -> list[tuple[str, str]]:
    return [
        (command, parameter.name)
        for command, told in main.commands.items()
        for parameter in told.params
        if isinstance(parameter, click.Option)
        and parameter.name not in APART
        and (command, parameter.name) not in REFINING
    ]


@pytest.mark.parametrize(("command", "name"), cases())
def test_every_option_tells_the_work_something(
    command: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class ReachedError(Exception):
        pass

    calls: list[str] = []

    def work(*given: Any, **told: Any) -> None:
        shown = {key: value for key, value in told.items() if not callable(value)}
        calls.append(repr(([one for one in given if not callable(one)], shown)))
        raise ReachedError

    monkeypatch.setattr(importlib.import_module(f"slamcli.run.{command}"), command, work)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()
    for file in "abc":
        (tmp_path / "frames" / f"{file}.png").write_bytes(b"")
    option = next(p for p in main.commands[command].params if p.name == name)
    assert isinstance(option, click.Option)
    for more in ([], other_value(option)):
        result = CliRunner().invoke(main, [command, *ARGUMENTS[command], *more])
        assert isinstance(result.exception, ReachedError), (more, result.output, result.exception)
    assert calls[0] != calls[1], f"slam {command} {option.opts[0]} changes nothing"
