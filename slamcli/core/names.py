"""Names of files as text: those that are not UTF-8 have bytes that no text can be written with."""

from __future__ import annotations


def readable(text: str) -> str:
    r"""Return a text with the bytes of names that are not UTF-8 as ``\xff``, to be written."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
