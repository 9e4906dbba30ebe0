"""`slam evaluate`."""

from __future__ import annotations

from pathlib import Path

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.values import AT_LEAST_ONE, PATH, Number
from slamcli.core.bounds import SECONDS_OR_ZERO


@command()
@click.argument("poses", type=PATH)
@click.argument("truth", type=PATH)
@click.option(
    "--tolerance",
    type=Number(SECONDS_OR_ZERO),
    default=0.01,
    show_default=True,
    help="Seconds: largest difference of the stamps of two poses that are compared.",
)
@click.option(
    "--delta",
    type=AT_LEAST_ONE,
    default=1,
    show_default=True,
    help="Number of poses over which the relative pose error (RPE) is measured.",
)
@common.json_output
def evaluate(poses: Path, truth: Path, tolerance: float, delta: int, as_json: bool) -> None:
    """Measure the error of poses against ground truth.

    POSES and TRUTH are trajectories: poses.csv, truth.csv, TUM or KITTI. They are matched by
    stamps, else by the frames' names, and aligned; the result is the absolute trajectory error
    (ATE), the relative pose error (RPE) and whether the covariances are consistent (NEES).
    """
    from slamcli.run.evaluate import evaluate as run_evaluate

    report = run_evaluate(poses, truth, tolerance_seconds=tolerance, delta=delta)
    result(report.json if as_json else "\n".join(report.lines))
