"""Ctrl-C, SIGTERM and SIGHUP: served between two steps of the work, or ending it at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# A terminal's Ctrl-C, a scheduler's or a container's request to end, and a closed terminal; Windows
# has no SIGHUP.
_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
# The argument of a KeyboardInterrupt that was acknowledged already.
ACKNOWLEDGED = "interrupted"
_Handler = Callable[[int, FrameType | None], None]


class Interruption:
    """The requests to stop, recorded by a signal handler and served between two steps.

    Parameters
    ----------
    acknowledge : function
        Prints one line at once, from within a signal handler.

    Attributes
    ----------
    happened : bool
        Whether a request was served, once or more.
    """

    def __init__(self, acknowledge: Callable[[str], None] = lambda _line: None) -> None:
        self.happened = False
        self._acknowledge = acknowledge
        self._requested = False
        self._ending = False

    def renewed(self) -> Interruption:
        """Return one that has not happened, for the work that follows a request."""
        return Interruption(self._acknowledge)

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Record requests meanwhile; a second one before the first is served ends the program."""
        with _handled_by(self._request):
            yield

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Raise KeyboardInterrupt at a request meanwhile, outside of `on_signals`."""
        with _handled_by(self._end):
            yield

    def stops_here(self) -> bool:
        """Return whether to stop the current stage; later stages run on until the next request."""
        requested, self._requested = self._requested, False
        self.happened |= requested
        return requested

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            self._end(number, frame)
            return
        self._requested = True
        self._acknowledge(
            "interrupted: stops after this step and writes what there is; once more: at once"
        )

    def _end(self, _number: int, _frame: FrameType | None) -> None:
        if self._ending:
            # What is half-written is being deleted; that must not be interrupted, too.
            return
        self._ending = True
        self._acknowledge(ACKNOWLEDGED)
        raise KeyboardInterrupt(ACKNOWLEDGED)


@contextmanager
def _handled_by(handler: _Handler) -> Iterator[None]:
    """Handle the signals meanwhile; without effect in a thread that none reaches.

    One that is ignored stays so: `nohup` ignores SIGHUP.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard = [number for number in _SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    before = [(number, signal.signal(number, handler)) for number in heard]
    try:
        yield
    finally:
        for number, earlier in before:
            signal.signal(number, earlier)
