"""The `slam` command line, run within a test."""

from __future__ import annotations

from click.testing import CliRunner, Result

from slamcli.cli.main import main


def slam(*arguments: object) -> Result:
    """Run a command; an error that is not turned into an exit code fails the test."""
    words = [str(argument) for argument in arguments]
    return CliRunner().invoke(main, words, catch_exceptions=False)
