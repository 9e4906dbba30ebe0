"""Every command-line option that more than one command takes, defined once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])
Decorator = Callable[[Command], Command]

PATH = click.Path(path_type=Path)
POSITIVE = click.FloatRange(min=0, min_open=True)

frames = click.argument("frames", nargs=-1, required=True, type=PATH)
calibration = click.option(
    "-c",
    "--calibration",
    type=PATH,
    help="From `slam calibrate`. Default: calibration.yaml in the frames' folder; without one "
    "the frames are taken as top-down pictures, in pixel units.",
)
overwrite = click.option("--overwrite", is_flag=True, help="Replace earlier results.")
seed = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all randomness."
)
max_range = click.option(
    "--max-range",
    type=POSITIVE,
    help="Metres on the floor beyond which the image is not used, in place of the calibration's.",
)
metres_per_pixel = click.option(
    "--metres-per-pixel",
    type=POSITIVE,
    help="Resolution of the result. Default: chosen from how finely the camera sees the floor.",
)
workers = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Threads; the result is the same for any number. Default: one a processor.",
)


def output(what: str, *, required: bool = False, default: str | None = None) -> Decorator[Any]:
    """Return the -o/--output option; `what` completes "Where ... goes"."""
    return click.option(
        "-o",
        "--output",
        type=PATH,
        required=required,
        default=default,
        show_default=default is not None,
        help=f"Where {what} goes.",
    )
