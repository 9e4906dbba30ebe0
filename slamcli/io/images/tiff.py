"""TIFF files: the first page's directory checked against the file, and further pages counted."""

from __future__ import annotations

import io
import struct
from typing import BinaryIO

from slamcli.core.errors import FrameError
from slamcli.io.images.header import Header, truncated

SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_WIDTH, _HEIGHT, _BITS, _ORIENTATION = 256, 257, 258, 274
_OFFSETS, _COUNTS = (273, 324), (279, 325)  # of strips, of tiles
_FORMATS = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MAX_PAGES = 10_000
_MAX_ENTRIES = 4096
_MAX_VALUES = 1_000_000
_READ_BITS = 16


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
        wanted = {_WIDTH, _HEIGHT, _BITS, _ORIENTATION, *_OFFSETS, *_COUNTS}
        for place in range(offset + head, offset + head + size * count, size):
            tag, kind = struct.unpack(f"{self._order}HH", self._read(place, 4))
            number = self._number(place + 4, letter)
            if tag not in wanted or kind not in _FORMATS or number > _MAX_VALUES:
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
    try:
        walker = _Walker(io.BytesIO(data))
        tags, _ = walker.directory(walker.first)
    except (EOFError, OSError, OverflowError, ValueError) as error:
        raise truncated() from error
    if not tags.get(_WIDTH) or not tags.get(_HEIGHT):
        raise FrameError("damaged: the TIFF does not say how large its picture is")
    bits = max(tags.get(_BITS) or (1,))
    if bits > _READ_BITS:
        raise FrameError(f"a TIFF of {bits} bits a sample cannot be read; save it as PNG")
    turn = (tags.get(_ORIENTATION) or (1,))[0]
    header = Header(tags[_WIDTH][0], tags[_HEIGHT][0], bits, turn if 1 <= turn <= 8 else 1)
    for offsets, counts in zip(_OFFSETS, _COUNTS, strict=True):
        ends = zip(tags.get(offsets, ()), tags.get(counts, ()), strict=False)
        if any(offset + count > len(data) for offset, count in ends):
            raise truncated()
    return header


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
