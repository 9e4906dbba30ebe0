"""WebP files: sizes against the file, and a dead stretch found though the format has no checksum.

The data are arithmetic-coded (VP8) or Huffman-coded (VP8L) and end with the last pixel. A stretch
of equal bytes stands for more blocks than the bytes that it replaced. The decoder is then done
before the data end, and accepts them without their last bytes, which it never does otherwise.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import BinaryIO

import cv2
import numpy as np

from slamcli.core.errors import FrameError
from slamcli.io.images.exif import EXIF_START, orientation
from slamcli.io.images.header import Header, check_length

_PICTURES = frozenset({b"VP8X", b"VP8L", b"VP8 "})
# The byte of a chunk that says whether the picture is transparent, and the bit of it.
_ALPHA, _ALPHA_FLAG = {b"VP8X": 0, b"VP8L": 4}, 0x10
# Zeros, and what erased memory reads as. Flat pictures have such stretches too.
_SUSPECT = (b"\0" * 32, b"\xff" * 32)
# A good file cannot lose two [benchmarks/damaged_pictures.py]; the rest is margin.
_SPARE_BYTES = 16
_VP8_HEADER_BYTES = 10
_MAX_FRAMES = 10_000


def is_webp(data: bytes) -> bool:
    """Return whether the file begins as a WebP does."""
    return data[:4] == b"RIFF" and data[8:12] == b"WEBP"


def read_header(data: bytes) -> Header:
    """Return what a WebP declares, its chunks checked against the file; raises FrameError."""
    check_length(data, 30)
    check_length(data, struct.unpack_from("<I", data, 4)[0] + 8)
    # Of an extended file the canvas comes first, and the picture that it stands for is bounded too.
    headers: list[Header] = []
    turn, has_alpha = 1, False
    for kind, place, end in _chunks(data):
        if kind in _PICTURES:
            body = data[place + 8 : place + 18]
            headers.append(Header(*_size(kind, body)))
            has_alpha |= kind in _ALPHA and bool(body[_ALPHA[kind]] & _ALPHA_FLAG)
        elif kind == b"EXIF":
            turn = orientation(data[place + 8 : end].removeprefix(EXIF_START))
    if not headers:
        raise FrameError("damaged: a WebP without a picture in it")
    return replace(headers[0], orientation=turn, has_alpha=has_alpha)


def _size(kind: bytes, body: bytes) -> tuple[int, int]:
    """Return the width and height that a chunk declares; raises FrameError."""
    check_length(body, 10)
    if kind == b"VP8X":
        return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
    if kind == b"VP8L":
        (packed,) = struct.unpack_from("<I", body, 1)
        return (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
    width, height = struct.unpack_from("<HH", body, 6)
    return width & 0x3FFF, height & 0x3FFF


def count_frames(stream: BinaryIO) -> int:
    """Return the number of pictures of an animation, 1 for a still picture."""
    count = 0
    stream.seek(12)
    while len(head := stream.read(8)) == 8 and count < _MAX_FRAMES:
        kind, length = struct.unpack("<4sI", head)
        count += kind == b"ANMF"
        stream.seek(length + length % 2, 1)
    return max(count, 1)


def check_dead_stretch(data: bytes) -> None:
    """Raise FrameError when a stretch of equal bytes is not what the picture was coded as."""
    if not any(stretch in data for stretch in _SUSPECT):
        return
    for kind, place, end in _chunks(data):
        body = data[place + 8 : end]
        first = 0
        if kind == b"VP8 ":
            tag = int.from_bytes(body[:3], "little")
            first = min(_VP8_HEADER_BYTES + (tag >> 5), len(body))
            # Less of the first partition: its length is in the upper 19 bits of the tag.
            short = max(tag - (_SPARE_BYTES << 5), 0).to_bytes(3, "little") + body[3:first]
            _check_partition(kind, body[:first], short[:-_SPARE_BYTES] + body[first:])
        if kind in {b"VP8 ", b"VP8L"}:
            _check_partition(kind, body[first:], body[:-_SPARE_BYTES])


def _chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the name, the offset and the end of each chunk; raises FrameError."""
    place = 12
    limit = struct.unpack_from("<I", data, 4)[0] + 8
    while place + 8 <= limit:
        kind, length = struct.unpack_from("<4sI", data, place)
        end = place + 8 + length
        check_length(data, end)
        yield kind, place, end
        place = end + length % 2


def _check_partition(kind: bytes, partition: bytes, body: bytes) -> None:
    """Raise FrameError when a chunk can be decoded without the end of a suspect partition.

    Parameters
    ----------
    partition : bytes
        With its end.
    body : bytes
        The chunk's data without that end.
    """
    if not any(stretch in partition for stretch in _SUSPECT):
        return
    length = len(body)
    body += bytes(length % 2)
    head = struct.pack("<4sI4s4sI", b"RIFF", len(body) + 12, b"WEBP", kind, length)
    if cv2.imdecode(np.frombuffer(head + body, np.uint8), cv2.IMREAD_GRAYSCALE) is not None:
        raise FrameError("damaged: a stretch of the file is zero")
