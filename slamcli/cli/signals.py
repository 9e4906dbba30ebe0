"""The line by which a signal is acknowledged."""

from __future__ import annotations

import os
from contextlib import suppress

_STDERR = 2


def acknowledge(line: str) -> None:
    """Print a line to the standard error at once, as a signal handler may.

    A stream of Python's must not be written to by a handler that has interrupted its writing. A
    terminal that was closed takes no line.
    """
    with suppress(OSError):
        os.write(_STDERR, f"{line}\n".encode())
