"""The README: every command stands in it, and every command line in it is accepted."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from slamcli.cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = ("README.md", "samples/README.md", "calibration/README.md")
LINES = [
    line.strip()
    for name in DOCUMENTS
    for block in re.findall(r"```\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), re.S)
    for line in block.splitlines()
    if line.strip().startswith("slam ")
]


def test_every_command_stands_in_the_readme() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for name in COMMANDS:
        assert f"`slam {name}`" in text


@pytest.mark.parametrize("line", LINES)
def test_every_command_line_is_accepted(line: str) -> None:
    words = shlex.split(line, comments=True)[1:]
    if words == ["--help"]:
        return
    group = click.Context(main)
    command = main.get_command(group, words[0])
    assert command is not None
    command.make_context(words[0], words[1:], parent=group)


def test_the_make_targets_are_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in ("demo", "test", "samples"):
        assert f"\n{target}:" in makefile
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
