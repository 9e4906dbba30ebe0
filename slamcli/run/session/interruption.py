"""Ctrl-C served between two steps of the work; a second one ends the program at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption:
    """The user's requests to stop, recorded by a signal handler and served between two steps.

    Attributes
    ----------
    happened : bool
        Whether a request was served, once or more.
    """

    def __init__(self) -> None:
        self.happened = False
        self._requested = False

    @contextmanager
    def on_sigint(self) -> Iterator[None]:
        """Record Ctrl-C meanwhile; without effect in a thread that no signal reaches."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.signal(signal.SIGINT, self._request)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def stops_here(self) -> bool:
        """Return whether to stop the current stage; later stages run on until the next request."""
        requested, self._requested = self._requested, False
        self.happened |= requested
        return requested

    def _request(self, _number: int, _frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
