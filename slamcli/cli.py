"""The command line: ten-line commands, each of which calls one function of `slamcli.run`."""

from __future__ import annotations

import sys
from typing import Any

import click

from slamcli import __version__
from slamcli.core.errors import SlamcliError


class SlamGroup(click.Group):
    """The one boundary that turns an error into a line and an exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; exit 1 with one line for an error that the user can mend."""
        try:
            return super().invoke(ctx)
        except SlamcliError as error:
            click.echo(f"Error: {error}", err=True)
            sys.exit(1)


@click.group(cls=SlamGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, package_name="slamcli", prog_name="slam")
def main() -> None:
    """Turn what a robot's camera saw of the floor into one metric map."""
