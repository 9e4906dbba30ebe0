"""The command group `slam`, which loads a command's module when that command is called."""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any

import click

from slamcli import __version__
from slamcli.core.errors import SlamcliError
from slamcli.core.exit_codes import ExitCode

# Each has a module of its name beside this one. The texts are the commands' own first sentences,
# which a test compares: the list of commands must not load what their options need.
COMMANDS = {
    "calibrate": "Calibrate the camera from photos of a square on the floor.",
    "detect": "Draw the feature points found in frames.",
    "evaluate": "Measure the error of poses against ground truth.",
    "extract": "Write the frames and readings of a video or bag as files.",
    "locate": "Find where frames lie in a finished map (relocalisation).",
    "match": "Estimate the transform between two pictures.",
    "render": "Paint a finished map again, with other options.",
    "simulate": "Simulate a drive over a floor, with ground truth.",
    "stitch": "Stitch the frames of a drive into one map of the floor.",
    "view": "Show the report of a map in the browser.",
    "warp": "Warp frames to metric bird's-eye views.",
}


class SlamGroup(click.Group):
    """A group of lazily loaded commands, and the one place where an error becomes an exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands."""
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return a command, loaded, or None when there is none of that name."""
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(import_module(f"slamcli.cli.{cmd_name}"), cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return a command with its arguments, which a report may show."""
        from slamcli.cli.options.repeating import remember

        name, command, rest = super().resolve_command(ctx, args)
        remember(ctx, rest)
        return name, command, rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without loading them."""
        with formatter.section("Commands"):
            formatter.write_dl(sorted(COMMANDS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an error that the user can correct is one line and an exit code."""
        from slamcli.cli.signals import acknowledge
        from slamcli.run.session.interruption import ACKNOWLEDGED, Interruption

        try:
            with Interruption(acknowledge).at_once():
                return super().invoke(ctx)
        except SlamcliError as error:
            click.echo(f"Error: {error}", err=True)
            sys.exit(ExitCode.ERROR)
        except MemoryError as error:
            click.echo(f"Error: out of memory: {error}; give less at a time", err=True)
            sys.exit(ExitCode.ERROR)
        except KeyboardInterrupt as error:
            if ACKNOWLEDGED not in error.args:
                click.echo("interrupted", err=True)
            sys.exit(ExitCode.INTERRUPTED)


@click.group(cls=SlamGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, package_name="slamcli", prog_name="slam")
def main() -> None:
    """Build a metric bird's-eye map of a floor from the frames of a moving camera.

    The map is an orthomosaic, to scale, with the camera's pose at every frame. `slam calibrate`
    comes first, then `slam stitch`.
    """
