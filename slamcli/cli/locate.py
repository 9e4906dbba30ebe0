"""`slam locate`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.fields import filled
from slamcli.cli.options.selection import selection_options
from slamcli.cli.options.values import PATH
from slamcli.core.config import FrameSelection


@command()
@click.argument("floor_map", metavar="MAP", type=PATH)
@common.frames
@common.output("CSV file for the poses, in the form of poses.csv.")
@common.json_output
@click.option("--strict", is_flag=True, help="Exit 3 when any frame is lost.")
@selection_options
@click.option(
    "--follow",
    is_flag=True,
    help="The frames are of one drive, in order: each is looked for first where it is expected.",
)
@common.workers
@common.overwrite
def locate(
    floor_map: Path,
    frames: tuple[Path, ...],
    output: Path | None,
    as_json: bool,
    strict: bool,
    follow: bool,
    workers: int | None,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Find where frames lie in a finished map (relocalisation).

    MAP is a folder that `slam stitch` wrote, or the map.slam in it. Each frame is located by
    itself, without those before it, unless --follow is given. The exit code is 1 when none of
    them lies in the map, 3 when most do not.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.locate import locate as run_locate

    with open_session(workers) as session:
        report = run_locate(
            floor_map,
            frames,
            output,
            overwrite=overwrite,
            strict=strict,
            selection=filled(FrameSelection(), flags),
            follow=follow,
            session=session,
        )
    result(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)
