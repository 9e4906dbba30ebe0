"""What several commands take, and how options are put together and read back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

import click

from slamcli.cli.options.values import PATH, POSITIVE

Options = TypeVar("Options")

Command = TypeVar("Command", bound=Callable[..., Any])

Decorator = Callable[[Command], Command]

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

self_calibrate = click.option(
    "--self-calibrate/--no-self-calibrate",
    default=False,
    help="Refine the camera by the frames themselves, where they determine it, and each frame's "
    "tilt and height; or take the calibration as it is [default].",
)

strict = click.option("--strict", is_flag=True, help="Exit 3 when any frame is lost.")

workers = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Threads; the result is the same for any number. Default: one a processor.",
)

scheduler = click.option(
    "--scheduler",
    metavar="ADDRESS",
    default="",
    help="Prepare frames and paint tiles on the workers of this Dask scheduler, such as "
    "tcp://host:8786; all must find the frames under the same path (needs slamcli[cluster]).",
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


def stacked(*decorators: Decorator[Any]) -> Decorator[Any]:
    """Return one decorator for several options, shown in the order given."""

    def decorate(command: Any) -> Any:
        for decorator in reversed(decorators):
            command = decorator(command)
        return command

    return decorate


def picked(kind: type[Options], told: Mapping[str, Any]) -> Options:
    """Return the options of one kind from all that the command line says; unsaid: the default."""
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    said = {name: value for name, value in told.items() if name in names and value is not None}
    return kind(**said)
