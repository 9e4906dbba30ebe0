"""Every command-line option that more than one command takes, defined once."""

from __future__ import annotations

from pathlib import Path

import click

overwrite = click.option("--overwrite", is_flag=True, help="Replace earlier results.")
seed = click.option(
    "--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Of all randomness."
)


def output(what: str, *, required: bool = False, default: str | None = None) -> click.Option:
    """Return the -o/--output option; `what` completes "Where ... goes"."""
    return click.option(  # type: ignore[return-value]
        "-o",
        "--output",
        type=click.Path(path_type=Path),
        required=required,
        default=default,
        show_default=default is not None,
        help=f"Where {what} goes.",
    )
