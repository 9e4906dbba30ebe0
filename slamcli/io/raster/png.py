"""PNG files written strip by strip: strips of rows are compressed on any thread, none is kept.

One call of OpenCV's encoder needs the whole picture in memory and one processor; for a map it takes
longer than painting it. By the PNG specification (W3C, third edition), and RFC 1950 and 1951.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.io.files import write_chunks
from slamcli.io.images.own import PNG_CHUNK

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TRUE_COLOUR_WITH_ALPHA = 6
_NO_FILTER, _UP = 0, 2
# On floor, level 1 over differences leaves a tenth more than level 6, in a third of the time.
_LEVEL, _WINDOW_BITS, _MEMORY_LEVEL = 1, 15, 9
_STREAM_HEADER, _EMPTY_LAST_BLOCK = b"\x78\x01", b"\x03\x00"
_ADLER_BASE = 65521
# Rows that are filtered at a time: of a map 13,000 pixels wide a strip would take 160 MB more.
_BLOCK_ROWS = 64


@dataclass(frozen=True, slots=True)
class Strip:
    """Some rows of a PNG, compressed.

    Attributes
    ----------
    data : bytes
        Deflated, to a byte's border; without an end.
    checksum : int
        Adler-32 of what was deflated.
    length : int
        Of what was deflated.
    """

    data: bytes
    checksum: int
    length: int


def compress(image: UInt8Array, mask: UInt8Array | None = None) -> Strip:
    """Compress rows without reference to the rows above them.

    Parameters
    ----------
    image : (h, w, 4) uint8 BGRA, or (h, w, 3) BGR
    mask : (h, w) uint8 or None
        The opacity of BGR pixels.
    """
    deflate = zlib.compressobj(_LEVEL, zlib.DEFLATED, -_WINDOW_BITS, _MEMORY_LEVEL)
    data, checksum, length = [], zlib.adler32(b""), 0
    above: UInt8Array | None = None
    for first in range(0, len(image), _BLOCK_ROWS):
        block = slice(first, first + _BLOCK_ROWS)
        colours = _rgba_rows(image[block], None if mask is None else mask[block])
        rows = _filtered(colours, above)
        above = colours[-1]
        data.append(deflate.compress(rows.data))
        checksum, length = zlib.adler32(rows.data, checksum), length + rows.size
    data.append(deflate.flush(zlib.Z_FULL_FLUSH))
    return Strip(b"".join(data), checksum, length)


def _rgba_rows(image: UInt8Array, mask: UInt8Array | None) -> UInt8Array:
    """Return (h, 4 w) uint8: the bytes of RGBA pixels, row by row."""
    code = cv2.COLOR_BGRA2RGBA if mask is None else cv2.COLOR_BGR2RGBA
    colours = cv2.cvtColor(image, code)
    if mask is not None:
        colours = cv2.insertChannel(mask, colours, 3)
    return np.asarray(colours, np.uint8).reshape(len(image), -1)


def _filtered(colours: UInt8Array, above: UInt8Array | None) -> UInt8Array:
    """Return rows of a PNG, each after its filter's number: differences to the row above."""
    rows = np.empty((len(colours), 1 + colours.shape[1]), np.uint8)
    rows[:, 0] = _UP
    if above is None:
        rows[0, 0], rows[0, 1:] = _NO_FILTER, colours[0]
    else:
        np.subtract(colours[0], above, out=rows[0, 1:])
    np.subtract(colours[1:], colours[:-1], out=rows[1:, 1:])
    return rows


def write_png(path: Path, width: int, height: int, strips: Iterable[Strip]) -> None:
    """Write a picture, completely or not at all, from its strips, the upper ones first.

    Raises
    ------
    OutputError
    """
    write_chunks(path, _chunks(width, height, strips))


def _chunks(width: int, height: int, strips: Iterable[Strip]) -> Iterator[bytes]:
    yield _SIGNATURE
    yield _chunk(
        b"IHDR", struct.pack(">IIBBBBB", width, height, 8, _TRUE_COLOUR_WITH_ALPHA, 0, 0, 0)
    )
    yield PNG_CHUNK
    yield _chunk(b"IDAT", _STREAM_HEADER)
    checksum = zlib.adler32(b"")
    for strip in strips:
        yield _chunk(b"IDAT", strip.data)
        checksum = _joined(checksum, strip)
    yield _chunk(b"IDAT", _EMPTY_LAST_BLOCK + struct.pack(">I", checksum))
    yield _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _joined(before: int, strip: Strip) -> int:
    """Return the checksum of all bytes so far and a strip's: sums, and sums of the sums."""
    low, high = before & 0xFFFF, before >> 16
    high += (strip.checksum >> 16) + strip.length * (low - 1)
    low += (strip.checksum & 0xFFFF) - 1
    return (high % _ADLER_BASE) << 16 | low % _ADLER_BASE
