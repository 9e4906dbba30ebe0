"""The command group `slam`, which loads a command's module when that command is called."""

from __future__ import annotations

import platform
import re
import sys
from importlib import import_module, metadata
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
    "live": "Map a live camera's floor, or locate it in a map.",
    "locate": "Find where frames lie in a finished map (relocalisation).",
    "match": "Estimate the transform between two pictures.",
    "render": "Paint a finished map again, with other options.",
    "simulate": "Simulate a drive over a floor, with ground truth.",
    "stitch": "Stitch the frames of a drive into one map of the floor.",
    "view": "Show the report of a map in the browser.",
    "warp": "Warp frames to metric bird's-eye views.",
}


# Extras whose packages no command uses.
_TOOLS = ("dev", "docs")


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
        from slamcli.cli.command import SlamCommand
        from slamcli.cli.options.repeating import remember

        name, command, rest = super().resolve_command(ctx, args)
        if isinstance(command, SlamCommand):
            rest = command.spelled_out(rest)
        remember(ctx, rest)
        return name, command, rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands without loading them."""
        with formatter.section("Commands"):
            formatter.write_dl(sorted(COMMANDS.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; an error that the user can correct is one line and an exit code."""
        from slamcli.cli.messages import messages
        from slamcli.cli.signals import acknowledge
        from slamcli.run.session.interruption import ACKNOWLEDGED, Interruption

        try:
            with Interruption(acknowledge).at_once():
                return super().invoke(ctx)
        except SlamcliError as error:
            # A name with a line feed in it leaves it one line.
            text = str(error).replace("\n", "\\n")
            messages().show(f"Error: {text}", error=True)
            sys.exit(ExitCode.ERROR)
        except OSError as error:
            # Names that are too long, links in circles, mounts that are gone.
            import logging

            logging.getLogger("slamcli").debug("the system refused", exc_info=True)
            name = "" if error.filename is None else f"{error.filename}: "
            messages().show(f"Error: {name}{error.strerror or error}", error=True)
            sys.exit(ExitCode.ERROR)
        except MemoryError as error:
            messages().show(f"Error: out of memory: {error}; give less at a time", error=True)
            sys.exit(ExitCode.ERROR)
        except KeyboardInterrupt as error:
            if ACKNOWLEDGED not in error.args:
                messages().show("interrupted")
            sys.exit(ExitCode.INTERRUPTED)


def _show_version(context: click.Context, _option: click.Parameter, value: bool) -> None:
    """Print the version and end."""
    if not value or context.resilient_parsing:
        return
    click.echo(f"slam {__version__}")
    if {"-v", "-vV", "-Vv"} & set(sys.argv[1:]):
        click.echo(f"{'Python':<24} {platform.python_version()}, {platform.platform()}")
        for name, version in sorted(_packages().items()):
            click.echo(f"{name:<24} {version}")
    context.exit()


def _packages() -> dict[str, str]:
    """Return the versions of the packages that this one needs or can use; `-` for missing ones."""
    found = {}
    for line in metadata.requires("slamcli") or []:
        name, marker = re.split(r"[<>=;\s\[]", line)[0], line.partition("extra ==")[2]
        if marker.strip(" \"'") in _TOOLS:
            continue
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "-"
    return found


def _choose(context: click.Context, option: click.Parameter, value: bool) -> None:
    """Take -v and -q also where they stand before the command."""
    from slamcli.cli.messages import choose

    choose(context, option, value)


@click.group(cls=SlamGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "-V",
    "--version",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_show_version,
    help="Show the version; with -v also those of Python and of what it works with.",
)
@click.option(
    "-q", "quiet", is_flag=True, is_eager=True, expose_value=False, callback=_choose, hidden=True
)
@click.option(
    "-v", "verbose", is_flag=True, is_eager=True, expose_value=False, callback=_choose, hidden=True
)
def main() -> None:
    """Build a metric bird's-eye map of a floor from the frames of a moving camera.

    The map is an orthomosaic, to scale, with the camera's pose at every frame. `slam calibrate`
    comes first, then `slam stitch`.
    """
