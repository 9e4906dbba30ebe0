"""The command line that report.html shows."""

from __future__ import annotations

import importlib
from typing import Any

import pytest
from command_line import slam
from spied_commands import Report


def test_it_has_what_was_given_and_changes_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    commands = list[str]()

    def stitch(*_: Any, command: str, **__: Any) -> Report:
        commands.append(command)
        return Report()

    monkeypatch.setattr(importlib.import_module("slamcli.run.stitch"), "stitch", stitch)
    words = "frames -o out --workers 2 --overwrite --no-loops --datum 1,2 -c c.yaml --strict"
    assert slam("stitch", *words.split()).exit_code == 0
    assert slam("stitch", "a b", "--max-turn", "20", "--resume").exit_code == 0
    assert commands == [
        "slam stitch frames --calibration c.yaml --datum 1,2 --strict --no-loops",
        "slam stitch 'a b' --max-turn 20",
    ]
