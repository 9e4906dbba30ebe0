"""Failures: what numerics raise on unforeseen input, where the API promises not to raise."""

from __future__ import annotations

import logging

import cv2

# Silent, unless the program that uses this library configures its logging.
_LOGGER = logging.getLogger("slamcli")
_LOGGER.addHandler(logging.NullHandler())

# Not among them: warnings made errors, and what ends a program.
FAILURES: tuple[type[Exception], ...] = (
    cv2.error,
    ArithmeticError,
    AssertionError,
    AttributeError,
    BufferError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)


def logged(error: Exception) -> str:
    """Log an exception with its traceback; return its type and text, on one line, for a reason.

    Behind a reason that a user reads may be a fault of this program: the log shows where.
    """
    _LOGGER.error("unforeseen failure", exc_info=error)
    words = " ".join(str(error).split())
    return f"{type(error).__name__} {words}"[:200].rstrip()
