"""Standard streams that cannot stop the work: closed, piped to what has ended, on a full disk."""

from __future__ import annotations

import errno
import io
import os
import sys
from pathlib import Path
from typing import Any, TextIO

# A reader such as `head` that has seen enough, or a terminal that was closed: nothing is missed.
_ENDED = {errno.EPIPE, errno.EBADF, errno.EIO}


class LenientStream(io.RawIOBase):
    """A raw stream whose failed writes are noted, not raised.

    Parameters
    ----------
    raw : raw stream
    owned : bool
        It is closed with this one.

    Attributes
    ----------
    fault : OSError or None
        The first failure that has lost something which somebody waits for.
    """

    def __init__(self, raw: io.RawIOBase, *, owned: bool = False) -> None:
        self._raw, self._owned = raw, owned
        self.fault: OSError | None = None

    def write(self, data: Any) -> int | None:
        """Write what can be written; the rest is lost."""
        try:
            return self._raw.write(data)
        except OSError as error:
            if error.errno not in _ENDED and self.fault is None:
                self.fault = error
            return len(data)

    def close(self) -> None:
        """End it."""
        super().close()
        if self._owned:
            self._raw.close()

    def writable(self) -> bool:
        """Return True."""
        return True

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._raw.fileno()

    def isatty(self) -> bool:
        """Return whether it is a terminal."""
        return self._raw.isatty()


def open_missing() -> None:
    """Open the standard streams that are closed: a result must not take their descriptors."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            # The lowest that is free: this one.
            os.open(os.devnull, os.O_RDWR)


def lenient(stream: TextIO | None) -> tuple[TextIO, LenientStream | None]:
    """Return a standard stream that cannot fail, and what it writes to; None for a missing one."""
    if stream is None:
        return Path(os.devnull).open("w", encoding="utf-8"), None
    if not isinstance(stream, io.TextIOWrapper):
        return stream, None
    buffer: Any = stream.buffer
    raw = LenientStream(getattr(buffer, "raw", buffer))
    text = io.TextIOWrapper(
        io.BufferedWriter(raw),
        stream.encoding,
        # A name that is not UTF-8 is printed as it can be.
        "backslashreplace" if stream.errors == "strict" else stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
    return text, raw


def replace_streams() -> LenientStream | None:
    """Put streams that cannot fail in place of the standard ones; return that of the output."""
    open_missing()
    sys.stdout, output = lenient(sys.stdout)
    sys.stderr, _ = lenient(sys.stderr)
    return output
