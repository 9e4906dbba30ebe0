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

# A log gets a line at every fifth of a stage, and at least one every so many seconds.
_LINES_PER_STAGE = 5
_MAX_SECONDS = 30.0


class ProgressBar:
    """Shows how far each stage is; a context manager, as a bar must be closed."""

    def __init__(self) -> None:
        self._messages = messages()
        self._terminal = sys.stderr.isatty() and not self._messages.quiet
        self._started = self._begun = self._shown = time.monotonic()
        self._stage = ""
        # Of the present stage: the step that was shown first, and that which was shown last.
        self._first = self._done = 0
        self._bar: tqdm[Any] | None = None

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of `stage` are finished."""
        if stage != self._stage or done < self._done:
            self._close()
            # What came between two stages is no part of either, nor is it known how long the
            # first step took.
            self._stage, self._begun, self._first = stage, time.monotonic(), done
        self._done = done
        self._log(done, total)
        if self._terminal:
            if self._bar is None:
                self._bar = tqdm(total=total, desc=stage, unit="frame")
            self._bar.update(done - self._bar.n)

    def _log(self, done: int, total: int) -> None:
        """Write a line of the stage, when one is due: time, done of total, rate, time left."""
        now = time.monotonic()
        due = done == total or done % max(1, total // _LINES_PER_STAGE) == 0
        if not (due or now - self._shown >= _MAX_SECONDS):
            return
        self._shown = now
        rate = (done - self._first) / max(now - self._begun, 1e-6)
        speed = f"{rate:.3g}/s, " if rate else ""
        left = f", {_clock((total - done) / rate)} left" if rate and done < total else ""
        line = f"{self._stage} {done}/{total}, {speed}{_clock(now - self._started)} so far"
        if self._terminal:
            self._messages.record(line + left)
        else:
            self._messages.show(line + left)

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
