"""Options and arguments of several commands: inputs, outputs, resources."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.options.fields import Decorator, option
from slamcli.cli.options.sections import OUTPUT, PERFORMANCE, expert, section
from slamcli.cli.options.values import PATH, POSITIVE, Number, Whole
from slamcli.core.bounds import METRES_PER_PIXEL, SEED, WORKERS
from slamcli.core.config import PaintOptions

if TYPE_CHECKING:
    from slamcli.core.config import MatchOptions
    from slamcli.simulation.config import SimulationOptions

frames = click.argument("frames", nargs=-1, required=True, type=PATH)

calibration = click.option(
    "-c",
    "--calibration",
    type=PATH,
    help="The calibration, from `slam calibrate`. Default: calibration.yaml in the frames' folder; "
    "without one the frames are taken as top-down pictures, and lengths are in pixels.",
)

metres_per_pixel = section(
    OUTPUT,
    option(
        PaintOptions(),
        "metres_per_pixel",
        "--metres-per-pixel",
        Number(METRES_PER_PIXEL),
        "Resolution of the result (GSD). It is the ground sampling distance; default: chosen from "
        "the camera's own sampling of the floor.",
    ),
)

max_range = click.option(
    "--max-range",
    type=POSITIVE,
    help="Metres of floor ahead that are used. Default: the calibration's limit.",
)

json_output = section(
    OUTPUT,
    click.option(
        "--json", "as_json", is_flag=True, help="Print the results as JSON, in place of text."
    ),
)

workers = section(
    PERFORMANCE,
    click.option(
        "--workers",
        type=Whole(WORKERS),
        help="Number of threads. The result is the same for any; default: one per processor.",
    ),
)

scheduler = expert(
    PERFORMANCE,
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        default="",
        help="Prepare frames and paint tiles on the workers of this Dask scheduler, such as "
        "tcp://host:8786; all must find the frames under the same path (needs slamcli[cluster]).",
    ),
)

overwrite = click.option("--overwrite", is_flag=True, help="Replace earlier results.")


def output(text: str, default: str | None = None) -> Decorator[Any]:
    """Return the -o/--output option."""
    shown = default is not None
    return click.option("-o", "--output", type=PATH, default=default, show_default=shown, help=text)


def seed(group: MatchOptions | SimulationOptions) -> Decorator[Any]:
    """Return the --seed option of a dataclass."""
    return option(group, "seed", "--seed", Whole(SEED), "Seed of all random numbers.")


def default_output(source: Path, suffix: str) -> Path:
    """Return the folder beside the frames' own that results go to: frames -> frames_mosaic.

    Of a video: drive.mp4 -> drive_mosaic.
    """
    from slamcli.io.containers.listing import CONTAINER_SUFFIXES

    folder = source.resolve() if source.is_dir() else source.resolve().parent
    if source.suffix.lower() in CONTAINER_SUFFIXES:
        folder = source.resolve().with_suffix("")
    beside = folder.parent / f"{folder.name}_{suffix}"
    return Path(os.path.relpath(beside)) if beside.is_relative_to(Path.cwd()) else beside
