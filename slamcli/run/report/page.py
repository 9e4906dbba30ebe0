"""The page's file: a template of this package, with the style, the script and the data in it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path

from slamcli import __version__
from slamcli.io.files import write_text

# In a script none of these may end the element, or begin a comment, whatever a file is named.
_ESCAPES = {ord(sign): f"\\u{ord(sign):04x}" for sign in "<>&\u2028\u2029"}
# Bytes of names that are not UTF-8, as `core.names.readable` writes them, in a text of JSON.
_ESCAPES |= {0xDC00 + byte: f"\\\\x{byte:02x}" for byte in range(0x80, 0x100)}


def write_page(path: Path, content: Mapping[str, object]) -> None:
    """Write one self-contained file; `content` is what its script shows."""
    data = json.dumps(
        {"version": __version__, **content},
        ensure_ascii=False,
        separators=(",", ":"),
        allow_nan=False,
    )
    text = resource("page.html")
    for mark, part in (("STYLE", resource("page.css")), ("SCRIPT", resource("page.js"))):
        text = text.replace(f"/*{mark}*/", part)
    before, after = text.split("/*DATA*/")
    write_text(path, before + data.translate(_ESCAPES) + after)


def resource(name: str) -> str:
    """Return a text file of this package."""
    return files("slamcli.run.report").joinpath(name).read_text(encoding="utf-8")
