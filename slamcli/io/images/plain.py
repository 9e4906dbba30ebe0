"""BMP, PNM and GIF files: what their short headers declare, against the file."""

from __future__ import annotations

import re
import struct
from typing import BinaryIO, NamedTuple

from slamcli.core.errors import FrameError
from slamcli.io.images.header import Header, check_length
from slamcli.io.images.plain_rows import PlainRows, plain_rows

# Possessive, or spaces without a number take for ever.
_PNM_NUMBER = rb"(?:\s|#[^\n]*\n)++(\d{1,9})"
_PNM_SIZE = re.compile(rb"P[1-6]" + _PNM_NUMBER * 2)
_PNM_SIZE_AND_RANGE = re.compile(rb"P[1-6]" + _PNM_NUMBER * 3)
_BITMAP, _BINARY = b"14", b"456"
# Of a BMP: without any, and with masks of its channels. Its pixels are whole bytes in
_UNCOMPRESSED, _WHOLE_BYTES = frozenset({0, 3}), frozenset({8, 16, 24, 32})
_MAX_GIF_FRAMES = 10_000


class _BmpLayout(NamedTuple):
    """Where the pixels of a BMP lie, bytes; its height is negative when the top row is first."""

    offset: int
    width: int
    height: int
    bits: int
    compression: int

    @property
    def stride(self) -> int:
        """Bytes from row to row."""
        return (self.width * self.bits + 31) // 32 * 4


def _bmp_layout(data: bytes) -> _BmpLayout:
    check_length(data, 34)
    offset, size = struct.unpack_from("<II", data, 10)
    if size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        return _BmpLayout(offset, width, height, bits, 0)
    width, height, _, bits, compression = struct.unpack_from("<iiHHI", data, 18)
    return _BmpLayout(offset, width, height, bits, compression)


def read_bmp_header(data: bytes) -> Header:
    """Return what a BMP declares; raises FrameError when it is cut."""
    layout = _bmp_layout(data)
    header = Header(layout.width, abs(layout.height))
    if layout.compression in _UNCOMPRESSED:
        check_length(data, layout.offset + layout.stride * header.height)
    return header


def bmp_rows(data: bytes) -> PlainRows | None:
    """Return the rows of a BMP, from the top; None when they are compressed, or of less a pixel."""
    layout = _bmp_layout(data)
    if layout.compression not in _UNCOMPRESSED or layout.bits not in _WHOLE_BYTES:
        return None
    shape = abs(layout.height), layout.width
    return plain_rows(data, layout.offset, layout.stride, shape, layout.bits // 8)


def is_bottom_up(data: bytes) -> bool:
    """Return whether the first row of a BMP is its lowest."""
    return _bmp_layout(data).height > 0


def read_pnm_header(data: bytes) -> Header:
    """Return what a PBM, PGM or PPM declares; raises FrameError when it is cut."""
    layout = _pnm_layout(data)
    header = Header(layout.width, layout.height, layout.bits)
    if layout.is_binary:
        check_length(data, layout.offset + layout.stride * layout.height)
    return header


def pnm_rows(data: bytes) -> PlainRows | None:
    """Return the rows of a PGM or PPM; None of texts and bitmaps. Raises FrameError."""
    layout = _pnm_layout(data)
    if not layout.is_binary and b"\0" in data:
        raise FrameError("damaged: a stretch of the file is zero")
    if not layout.is_binary or layout.bits == 1:
        return None
    shape, size = (layout.height, layout.width), layout.stride // layout.width
    return plain_rows(data, layout.offset, layout.stride, shape, size)


class _PnmLayout(NamedTuple):
    """Where the pixels of a PBM, PGM or PPM lie; without a meaning where they are texts."""

    offset: int
    width: int
    height: int
    bits: int
    stride: int
    is_binary: bool


def _pnm_layout(data: bytes) -> _PnmLayout:
    bitmap = data[1] in _BITMAP
    match = (_PNM_SIZE if bitmap else _PNM_SIZE_AND_RANGE).match(data[:4096])
    if match is None:
        raise FrameError("damaged: the PNM has no size in its header")
    width, height = int(match[1]), int(match[2])
    bits = 1 if bitmap else int(match[3]).bit_length()
    samples = 3 if data[1] == ord("6") else 1
    stride = (width + 7) // 8 if bitmap else width * samples * (2 if bits > 8 else 1)
    return _PnmLayout(match.end() + 1, width, height, bits, stride, data[1] in _BINARY)


def read_gif_header(data: bytes) -> Header:
    """Return what a GIF declares; raises FrameError."""
    check_length(data, 13)
    width, height = struct.unpack_from("<HH", data, 6)
    return Header(width, height)


def count_frames(stream: BinaryIO) -> int:
    """Return the number of pictures of a GIF, counted to the first that is damaged."""
    head = stream.read(13)
    if len(head) < 13:
        return 0
    stream.seek(_palette_bytes(head[10]), 1)
    screen = struct.unpack_from("<2H", head, 6)
    count = 0
    while count < _MAX_GIF_FRAMES:
        kind = stream.read(1)
        if kind == b",":
            descriptor = stream.read(9)
            # One that lies outside of the screen would make it, and all after it, larger.
            if len(descriptor) < 9 or not _lies_within(screen, descriptor):
                break
            stream.seek(_palette_bytes(descriptor[8]) + 1, 1)
            count += 1
        elif kind == b"!":
            stream.seek(1, 1)
        else:
            break
        while length := stream.read(1)[:1]:
            if length == b"\0":
                break
            stream.seek(length[0], 1)
    return count


def _lies_within(screen: tuple[int, ...], descriptor: bytes) -> bool:
    left, top, width, height = struct.unpack_from("<4H", descriptor)
    return bool(left + width <= screen[0] and top + height <= screen[1])


def _palette_bytes(flags: int) -> int:
    return 3 * 2 ** ((flags & 7) + 1) if flags & 0x80 else 0
