"""`slam live`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.values import AT_LEAST_ONE, PATH, Whole
from slamcli.core.bounds import Bounds


@command()
@click.argument("source")
@click.option(
    "-c",
    "--calibration",
    type=PATH,
    help="The calibration, from `slam calibrate`. Default: calibration.yaml in this folder; "
    "without one the frames are taken as top-down pictures, and lengths are in pixels.",
)
@click.option(
    "--map",
    "floor_map",
    type=PATH,
    help="Locate in this finished map. The output of slam stitch, whose camera is used.",
)
@common.output(
    "Folder of the map; with --map a CSV of the poses. Default: live_mosaic, with --map none."
)
@common.overwrite
@click.option("--record", type=PATH, help="New folder that keeps the frames.", metavar="DIR")
@click.option("--max-frames", type=AT_LEAST_ONE, help="End after so many frames.")
@click.option(
    "--port",
    type=Whole(Bounds(0, 65535, whole=True)),
    default=0,
    help="Port of this machine that shows the page. Default: a free one.",
)
@click.option("--browser/--no-browser", default=True, help="Open the page in the browser.")
@common.json_output
@common.workers
def live(
    source: str,
    calibration: Path | None,
    floor_map: Path | None,
    output: Path | None,
    record: Path | None,
    max_frames: int | None,
    port: int,
    workers: int | None,
    *,
    overwrite: bool,
    browser: bool,
    as_json: bool,
) -> None:
    """Map a live camera's floor, or locate it in a map.

    SOURCE is a camera's number (0), a device (/dev/video0) or the address of an RTSP or HTTP
    stream. A page for this machine's browser shows the camera, the map and the pose. Ctrl-C ends
    it; the map is then written as slam stitch does.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.live import LiveOptions
    from slamcli.run.live import live as run_live

    if floor_map is not None and calibration is not None:
        raise click.UsageError("--map has its own camera; leave out -c")
    options = LiveOptions(floor_map, record, max_frames, port, browser, overwrite)
    with open_session(workers) as session:
        report = run_live(source, calibration, output, options, session)
    result(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)
