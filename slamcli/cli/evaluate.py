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
@click.argument("poses", nargs=-1, required=True, type=PATH)
@click.option("--truth", type=PATH, help="The true trajectory. Default: the last of POSES.")
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
@click.option(
    "--plot",
    type=PATH,
    help="Draw the paths, and the errors along them with their sigmas: .pdf, .svg or .png (needs "
    "slamcli[plot]).",
)
@click.option("--table", type=PATH, help="Write the errors as a table: .csv, or .tex for LaTeX.")
@common.overwrite
@common.json_output
def evaluate(
    poses: tuple[Path, ...],
    truth: Path | None,
    tolerance: float,
    delta: int,
    plot: Path | None,
    table: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Measure the error of poses against ground truth.

    POSES are trajectories: poses.csv, truth.csv, TUM, KITTI or HD Ground, or the folder of a map,
    a simulated drive or a benchmark's sequence; without --truth the last of them is the truth. They
    are matched by stamps, else by the frames' names, and aligned; the result is the absolute
    trajectory error (ATE), the relative pose error (RPE) and whether the covariances are consistent
    (NEES).
    """
    from slamcli.run.evaluate import EvaluateOptions
    from slamcli.run.evaluate import evaluate as run_evaluate

    if truth is None:
        *others, truth = poses
        poses = tuple(others)
    if not poses:
        raise click.UsageError("give poses and the truth: slam evaluate POSES TRUTH")
    options = EvaluateOptions(tolerance, delta, plot, table, overwrite)
    report = run_evaluate(poses, truth, options)
    result(report.json if as_json else "\n".join(report.lines))
