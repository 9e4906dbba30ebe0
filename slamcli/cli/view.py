"""`slam view`."""

from __future__ import annotations

from pathlib import Path

import click

from slamcli.cli.command import command
from slamcli.cli.messages import messages, result
from slamcli.cli.options import common
from slamcli.cli.options.values import PATH, Whole
from slamcli.core.bounds import Bounds


@command()
@click.argument("run", type=PATH)
@click.option(
    "--port",
    type=Whole(Bounds(0, 65535, whole=True)),
    default=0,
    help="Port of this machine that the browser connects to. Default: a free one.",
)
@click.option("--browser/--no-browser", default=True, help="Open it in the browser.")
@click.option(
    "--rerun",
    type=PATH,
    metavar="FILE.rrd",
    help="Write a recording for rerun's viewer instead: floor, path, loops, every frame's picture.",
)
@common.json_output
@common.overwrite
def view(
    run: Path, port: int, rerun: Path | None, *, browser: bool, as_json: bool, overwrite: bool
) -> None:
    """Show the report of a map in the browser.

    RUN is the output folder of `slam stitch`. The report is served to this machine alone, with the
    map's pyramid of tiles (--format deepzoom) at full resolution, until Ctrl-C.
    """
    from slamcli.run.view import view as run_view

    shown = run_view(run, port=port, browser=browser, rerun=rerun, overwrite=overwrite)
    result(shown.json if as_json else "\n".join(shown.lines))
    try:
        shown.serve()
    except KeyboardInterrupt:
        # The way to end it.
        messages().show("ended")
