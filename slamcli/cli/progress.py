"""Progress display: a bar on a terminal, a few lines per stage in a log."""

from __future__ import annotations

import sys
from typing import Any, Self

import click
from tqdm import tqdm

_LINES_PER_STAGE = 5


class ProgressBar:
    """The progress of each stage; a context manager, as a bar must be closed."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._stage = ""
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of a stage are finished."""
        if not self._terminal:
            if done == total or done % max(1, total // _LINES_PER_STAGE) == 0:
                click.echo(f"{stage} {done}/{total}", err=True)
            return
        if self._bar is None or stage != self._stage:
            self._close()
            self._stage, self._bar = stage, tqdm(total=total, desc=stage, unit="frame")
        self._bar.update(done - self._bar.n)

    def tell(self, line: str) -> None:
        """Print a line that is not a result."""
        self._close()
        click.echo(line, err=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None
