"""`slam simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options import simulation as options
from slamcli.cli.options.fields import filled
from slamcli.cli.options.values import PATH
from slamcli.simulation.config import SimulationOptions


@command()
@click.argument("output", type=PATH)
@options.floor_options
@options.path_options
@options.camera_options
@options.imaging_options
@options.disturbance_options
@options.output_options
@common.json_output
@common.workers
@options.seed_option
@common.overwrite
def simulate(
    output: Path,
    layout: Path | None,
    as_json: bool,
    workers: int | None,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Simulate a drive over a floor, with ground truth.

    OUTPUT is a folder for the frames, a calibration photo, the true poses, and the readings of
    odometry, compass and GPS.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.simulate import simulate as run_simulate

    with open_session(workers) as session:
        report = run_simulate(
            output,
            filled(SimulationOptions(), flags),
            overwrite=overwrite,
            session=session,
            layout=layout,
        )
    result(report.json if as_json else "\n".join(report.lines))
