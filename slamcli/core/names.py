"""Names of files as text: those that are not UTF-8 have bytes that no text can be written with."""

from __future__ import annotations


def readable(text: str) -> str:
    r"""Return a text with the bytes of names that are not UTF-8 as ``\xff``, to be written."""
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


# All that a terminal may obey, but line feeds and tabs: C0, DEL and C1.
_CONTROLS = {
    code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if code not in {9, 10}
}


def printable(text: str) -> str:
    r"""Return a text whose control characters are written as ``\x1b``: a name may have them."""
    return text.translate(_CONTROLS)
