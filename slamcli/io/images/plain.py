"""BMP, PNM and GIF files: what their short headers declare, against the file."""

from __future__ import annotations

import re
import struct
from typing import BinaryIO

from slamcli.core.errors import FrameError
from slamcli.io.images.header import Header, check_length

# Possessive, or spaces without a number take for ever.
_PNM_NUMBER = rb"(?:\s|#[^\n]*\n)++(\d{1,9})"
_PNM_SIZE = re.compile(rb"P[1-6]" + _PNM_NUMBER * 2)
_PNM_SIZE_AND_RANGE = re.compile(rb"P[1-6]" + _PNM_NUMBER * 3)
_BITMAP, _BINARY = b"14", b"456"
_MAX_GIF_FRAMES = 10_000


def read_bmp_header(data: bytes) -> Header:
    """Return what a BMP declares; raises FrameError when it is cut."""
    check_length(data, 34)
    offset, size = struct.unpack_from("<II", data, 10)
    if size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        compression = 0
    else:
        width, height, _, bits, compression = struct.unpack_from("<iiHHI", data, 18)
    header = Header(width, abs(height))
    if not compression:
        check_length(data, offset + (width * bits + 31) // 32 * 4 * abs(height))
    return header


def read_pnm_header(data: bytes) -> Header:
    """Return what a PBM, PGM or PPM declares; raises FrameError when it is cut."""
    bitmap = data[1] in _BITMAP
    match = (_PNM_SIZE if bitmap else _PNM_SIZE_AND_RANGE).match(data[:4096])
    if match is None:
        raise FrameError("damaged: the PNM has no size in its header")
    width, height = int(match[1]), int(match[2])
    bits = 1 if bitmap else int(match[3]).bit_length()
    header = Header(width, height, bits)
    if data[1] in _BINARY:
        samples = 3 if data[1] == ord("6") else 1
        row = (width + 7) // 8 if bitmap else width * samples * (2 if bits > 8 else 1)
        check_length(data, match.end() + 1 + row * height)
    return header


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
    count = 0
    while count < _MAX_GIF_FRAMES:
        kind = stream.read(1)
        if kind == b",":
            descriptor = stream.read(9)
            if len(descriptor) < 9:
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


def _palette_bytes(flags: int) -> int:
    return 3 * 2 ** ((flags & 7) + 1) if flags & 0x80 else 0
