"""The mark of pictures that this program writes for people: lying among frames, they are none."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

_TEXT = b"made by slamcli, not by a camera"
_HEAD_BYTES = 256
_PNG_HEADER_BYTES = 33
_JPEG_START_BYTES, _JPEG_COMMENT = 2, b"\xff\xfe"
_PNG_BODY = b"tEXtComment\0" + _TEXT
# Comes after the header of a PNG.
PNG_CHUNK = (
    struct.pack(">I", len(_PNG_BODY) - 4) + _PNG_BODY + struct.pack(">I", zlib.crc32(_PNG_BODY))
)


def marked(data: bytes) -> bytes:
    """Return an encoded PNG or JPEG with the mark in it."""
    if data.startswith(b"\x89PNG"):
        return data[:_PNG_HEADER_BYTES] + PNG_CHUNK + data[_PNG_HEADER_BYTES:]
    comment = _JPEG_COMMENT + struct.pack(">H", len(_TEXT) + 2) + _TEXT
    # After the first segment, which a JFIF file begins with.
    place = _JPEG_START_BYTES + 2 + struct.unpack_from(">H", data, _JPEG_START_BYTES + 2)[0]
    return data[:place] + comment + data[place:]


def is_marked(path: Path) -> bool:
    """Return whether a regular file has the mark."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as stream:
            return _TEXT in stream.read(_HEAD_BYTES)
    except OSError:  # the frame's own reason says so
        return False
