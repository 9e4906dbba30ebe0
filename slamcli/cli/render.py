"""`slam render`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.fields import filled
from slamcli.cli.options.products import product_options
from slamcli.cli.options.values import PATH
from slamcli.core.config import ProductOptions


@command()
@click.argument("run", type=PATH)
@common.output("Folder of the map. Default: RUN with _render added.")
@product_options
@click.option("--frames", type=PATH, help="Folder of the frames, when it has moved since.")
@common.json_output
@common.workers
@common.overwrite
def render(
    run: Path,
    output: Path | None,
    frames: Path | None,
    workers: int | None,
    as_json: bool,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Paint a finished map again, with other options.

    RUN is the output folder of `slam stitch`. The poses stay as they are: no frame is located
    again.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.render import render as run_render

    with open_session(workers) as session:
        report = run_render(
            run,
            frames,
            output or common.default_output(run, "render"),
            filled(ProductOptions(), flags),
            overwrite=overwrite,
            session=session,
        )
    result(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)
