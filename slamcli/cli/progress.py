"""Progress display: a bar on a terminal, a few lines per stage in a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

from tqdm import tqdm

from slamcli.cli.messages import messages
from slamcli.cli.signals import acknowledge
from slamcli.run.session.executor import default_workers
from slamcli.run.session.interruption import Interruption
from slamcli.run.session.session import Session

# A log gets a line at every fifth of a stage, but not within a second of the one before, and at
# least one every so many seconds.
_LINES_PER_STAGE = 5
_MIN_SECONDS, _MAX_SECONDS = 1.0, 30.0


class ProgressBar:
    """Shows how far each stage is; a context manager, as a bar must be closed."""

    def __init__(self) -> None:
        self._messages = messages()
        self._terminal = sys.stderr.isatty() and not self._messages.quiet
        self._started = self._begun = self._latest = self._shown = time.monotonic()
        self._stage, self._next = "", 1.0
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of `stage` are finished."""
        if stage != self._stage:
            self._close()
            self._stage, self._begun, self._next = stage, self._latest, 1.0
        self._log(done, total)
        if self._terminal:
            if self._bar is None:
                self._bar = tqdm(total=total, desc=stage, unit="frame")
            self._bar.update(done - self._bar.n)

    def _log(self, done: int, total: int) -> None:
        """Write a line of the stage, when one is due: time, done of total, rate, time left."""
        now = self._latest = time.monotonic()
        since = now - self._shown
        share = _LINES_PER_STAGE * done / max(total, 1)
        due = share >= self._next and since >= _MIN_SECONDS
        if not (done == total or due or since >= _MAX_SECONDS):
            return
        self._next, self._shown = int(share) + 1.0, now
        rate = done / max(now - self._begun, 1e-6)
        left = f", {_clock((total - done) / rate)} left" if done < total else ""
        line = f"{_clock(now - self._started)}  {self._stage} {done}/{total}, {rate:.3g}/s{left}"
        if self._terminal:
            self._messages.record(line)
        else:
            self._messages.show(line)

    def notify(self, line: str) -> None:
        """Print a line that is not a result."""
        self._close()
        self._messages.show(line)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def _clock(seconds: float) -> str:
    """Return a time as minutes and seconds."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


@contextmanager
def open_session(workers: int | None, scheduler: str = "") -> Iterator[Session]:
    """Yield the session of a command, with a progress bar; by default on all processors."""
    with ProgressBar() as bar:
        interruption = Interruption(acknowledge)
        yield Session(workers or default_workers(), scheduler, bar, bar.notify, interruption)
