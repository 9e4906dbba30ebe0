"""Ctrl-C between two steps, not in the middle of one; a second one ends at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption:
    """Whether the user has asked to stop.

    Attributes
    ----------
    happened : bool
        Whether that has been heeded, once or more.
    """

    def __init__(self) -> None:
        self.happened = False
        self._asked = False

    def note(self, _number: int, _frame: FrameType | None) -> None:
        """Take note of a request; raise KeyboardInterrupt at one more before it was heeded."""
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True

    def heeded(self) -> bool:
        """Tell whether to stop what is being done now; what follows goes on until asked again."""
        asked, self._asked = self._asked, False
        self.happened |= asked
        return asked


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Yield what tells whether Ctrl-C was pressed; in a thread that no signal reaches, never."""
    interruption = Interruption()
    if threading.current_thread() is not threading.main_thread():
        yield interruption
        return
    before = signal.signal(signal.SIGINT, interruption.note)
    try:
        yield interruption
    finally:
        signal.signal(signal.SIGINT, before)
