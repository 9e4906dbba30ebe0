"""Failures: what numerics raise on unforeseen input, where the API promises not to raise."""

from __future__ import annotations

import cv2

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


def failure_text(error: Exception) -> str:
    """Return an exception as the end of a reason, on one line."""
    words = " ".join(str(error).split())
    return f"{type(error).__name__} {words}"[:200].rstrip()
