"""Progress display: a bar on a terminal, a few lines per stage in a log."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

import click
from tqdm import tqdm

from slamcli.cli.signals import acknowledge
from slamcli.run.session.executor import default_workers
from slamcli.run.session.interruption import Interruption
from slamcli.run.session.session import Session

_LINES_PER_STAGE = 5


class ProgressBar:
    """Shows how far each stage is; a context manager, as a bar must be closed."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._stage = ""
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of `stage` are finished."""
        if not self._terminal:
            if done == total or done % max(1, total // _LINES_PER_STAGE) == 0:
                click.echo(f"{stage} {done}/{total}", err=True)
            return
        if self._bar is None or stage != self._stage:
            self._close()
            self._stage, self._bar = stage, tqdm(total=total, desc=stage, unit="frame")
        self._bar.update(done - self._bar.n)

    def notify(self, line: str) -> None:
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


@contextmanager
def open_session(workers: int | None, scheduler: str = "") -> Iterator[Session]:
    """Yield the session of a command, with a progress bar; by default on all processors."""
    with ProgressBar() as bar:
        interruption = Interruption(acknowledge)
        yield Session(workers or default_workers(), scheduler, bar, bar.notify, interruption)
