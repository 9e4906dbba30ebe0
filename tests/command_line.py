"""The `slam` command line, run within a test."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner, Result

from slamcli.cli.main import main


def slam(*arguments: object) -> Result:
    """Run a command; an error that is not turned into an exit code fails the test."""
    words = [str(argument) for argument in arguments]
    return CliRunner().invoke(main, words, catch_exceptions=False)


def contents(folder: Path) -> dict[str, bytes]:
    """Return all files of a folder, hidden ones too, but the one that says how long a run took."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != "timing.toml")
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}
