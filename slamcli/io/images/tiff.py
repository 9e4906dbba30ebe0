"""TIFF files: the first page's directory checked against the file, and further pages counted."""

from __future__ import annotations

import io
import struct
import zlib
from itertools import pairwise
from typing import BinaryIO

from slamcli.core.errors import FrameError
from slamcli.io.images.header import Header, truncated
from slamcli.io.images.plain_rows import PlainRows, plain_rows

SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WIDTH, _HEIGHT, _BITS, _ORIENTATION = 256, 257, 258, 274
_COMPRESSION, _SAMPLES, _PLANES, _TILE_WIDTH, _TILE_HEIGHT = 259, 277, 284, 322, 323
_OFFSETS, _COUNTS = (273, 324), (279, 325)  # of strips, of tiles
_FORMATS = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MAX_PAGES = 10_000
_MAX_ENTRIES = 4096
_MAX_VALUES = 1_000_000
_READ_BITS = 16
_PLAIN, _LZW, _JPEG, _PACKBITS, _DEFLATE = 1, 5, 7, 32773, frozenset({8, 32946})
# Of others OpenCV makes black pictures.
_READ_METHODS = frozenset({_PLAIN, _LZW, _JPEG, _PACKBITS, *_DEFLATE})
# Zeros, and what erased memory reads as.
_SUSPECT = (b"\0" * 32, b"\xff" * 32)
_SPARE_BYTES = 65_536
# Channels one after the other.
_SEPARATE = 2
# A channel beyond the colours that says what is transparent, in two ways.
_EXTRA_SAMPLES, _TRANSPARENT = 338, frozenset({1, 2})


_WANTED = {
    *(_WIDTH, _HEIGHT, _BITS, _ORIENTATION, _COMPRESSION, _SAMPLES, _PLANES),
    *(_TILE_WIDTH, _TILE_HEIGHT, _EXTRA_SAMPLES),
    *_OFFSETS,
    *_COUNTS,
}


class _Walker:
    """A reader of the directories of a TIFF or BigTIFF file."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        start = self._read(0, 4)
        self._order = "<" if start[:2] == b"II" else ">"
        self._big = b"+" in start
        self.first = self._number(8, "Q") if self._big else self._number(4, "I")

    def directory(self, offset: int) -> tuple[dict[int, tuple[int, ...]], int]:
        """Return the integer tags of a directory, and the offset of the next; raises OSError."""
        size, letter, head = (20, "Q", 8) if self._big else (12, "I", 2)
        count = self._number(offset, "Q" if self._big else "H")
        if count > _MAX_ENTRIES:
            raise EOFError
        tags: dict[int, tuple[int, ...]] = {}
        for place in range(offset + head, offset + head + size * count, size):
            tag, kind = struct.unpack(f"{self._order}HH", self._read(place, 4))
            number = self._number(place + 4, letter)
            if tag not in _WANTED or kind not in _FORMATS or number > _MAX_VALUES:
                continue
            layout = f"{self._order}{number}{_FORMATS[kind]}"
            length = struct.calcsize(layout)
            inline = place + (12 if self._big else 8)
            at = inline if length <= size - (inline - place) else self._number(inline, letter)
            tags[tag] = struct.unpack(layout, self._read(at, length))
        return tags, self._number(offset + head + size * count, letter)

    def _number(self, offset: int, letter: str) -> int:
        layout = f"{self._order}{letter}"
        return int(struct.unpack(layout, self._read(offset, struct.calcsize(layout)))[0])

    def _read(self, offset: int, count: int) -> bytes:
        self._stream.seek(offset)
        data = self._stream.read(count)
        if len(data) < count:
            raise EOFError
        return data


def read_header(data: bytes) -> Header:
    """Return what the first page declares, its strips or tiles in the file; raises FrameError."""
    tags = _first_page(data)
    if not tags.get(_WIDTH) or not tags.get(_HEIGHT):
        raise FrameError("damaged: the TIFF does not say how large its picture is")
    bits = max(tags.get(_BITS) or (1,))
    if bits > _READ_BITS:
        raise FrameError(f"a TIFF of {bits} bits a sample cannot be read; save it as PNG")
    method = _first(tags, _COMPRESSION)
    if method not in _READ_METHODS:
        raise FrameError(f"a TIFF of compression {method} cannot be read; save it as PNG")
    if tags.get(_TILE_WIDTH) and tags.get(_TILE_HEIGHT):
        Header(tags[_TILE_WIDTH][0], tags[_TILE_HEIGHT][0], bits)  # the same limits
    turn = _first(tags, _ORIENTATION)
    turn = turn if 1 <= turn <= 8 else 1
    has_alpha = not _TRANSPARENT.isdisjoint(tags.get(_EXTRA_SAMPLES, ()))
    header = Header(tags[_WIDTH][0], tags[_HEIGHT][0], bits, turn, has_alpha)
    if any(offset + count > len(data) for offset, count in _parts(tags)):
        raise truncated()
    return header


def check_dead_stretch(data: bytes) -> None:
    """Raise FrameError when a stretch of equal bytes lies in compressed data that cannot have one.

    Neither LZW nor PackBits writes the same code three times in a row; deflate has a checksum. The
    decoder goes on with what a damaged strip gives, and says nothing.
    """
    tags = _first_page(data)
    method = _first(tags, _COMPRESSION)
    if method not in {_LZW, _PACKBITS, *_DEFLATE}:
        return
    # No strip is larger than the picture; the tiles at its border may be.
    samples = _first(tags, _SAMPLES) * max(tags.get(_BITS) or (1,)) // 8 + 1
    limit_bytes = samples * tags[_WIDTH][0] * tags[_HEIGHT][0] + _SPARE_BYTES
    for offset, count in _parts(tags):
        part = data[offset : offset + count]
        if not any(stretch in part for stretch in _SUSPECT):
            continue
        if method not in _DEFLATE or not _inflates(part, limit_bytes):
            raise FrameError("damaged: a stretch of the file is zero")


def tiff_rows(data: bytes) -> PlainRows | None:
    """Return the rows of a TIFF without compression, in strips that follow one another, else None.

    Where channels lie one after the other, as pictures below one another.
    """
    tags = _first_page(data)
    parts, width, height = _parts(tags), tags[_WIDTH][0], tags[_HEIGHT][0]
    bits, samples = max(tags.get(_BITS) or (1,)), _first(tags, _SAMPLES)
    size = samples * bits // 8
    in_order = all(a + count == b for (a, count), (b, _) in pairwise(parts))
    is_whole = sum(count for _, count in parts) == width * height * size
    is_plain = _first(tags, _COMPRESSION) == _PLAIN and bits % 8 == 0
    if not (is_plain and parts and in_order and is_whole) or tags.get(_TILE_WIDTH):
        return None
    planes = samples if _first(tags, _PLANES) == _SEPARATE else 1
    shape = planes * height, width
    return plain_rows(data, parts[0][0], width * size // planes, shape, size // planes)


def _first_page(data: bytes) -> dict[int, tuple[int, ...]]:
    try:
        walker = _Walker(io.BytesIO(data))
        return walker.directory(walker.first)[0]
    except (EOFError, OSError, OverflowError, ValueError) as error:
        raise truncated() from error


def _first(tags: dict[int, tuple[int, ...]], tag: int) -> int:
    """Return a tag's first value; 1, the default of those that are read so, where it is missing."""
    return (tags.get(tag) or (1,))[0]


def _parts(tags: dict[int, tuple[int, ...]]) -> list[tuple[int, int]]:
    """Return offset and length of the strips and tiles, bytes."""
    return [
        part
        for offsets, counts in zip(_OFFSETS, _COUNTS, strict=True)
        for part in zip(tags.get(offsets, ()), tags.get(counts, ()), strict=False)
    ]


def _inflates(part: bytes, limit_bytes: int) -> bool:
    """Return whether deflated data end with the right checksum within a length."""
    inflater = zlib.decompressobj()
    try:
        inflater.decompress(part, limit_bytes)
    except zlib.error:
        return False
    return inflater.eof


def count_pages(stream: BinaryIO) -> int:
    """Return the number of pages, counted to the first that is damaged."""
    seen: set[int] = set()
    try:
        walker = _Walker(stream)
        offset = walker.first
        while offset and offset not in seen and len(seen) < _MAX_PAGES:
            _, following = walker.directory(offset)
            seen.add(offset)
            offset = following
    except (EOFError, OSError, OverflowError, ValueError):
        pass
    return len(seen)
