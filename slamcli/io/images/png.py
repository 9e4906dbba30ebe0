"""PNG files: chunk lengths against the file, and the checksum of every chunk with pixels."""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

from slamcli.core.errors import FrameError
from slamcli.io.images.exif import orientation
from slamcli.io.images.header import Header, check_length, truncated

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_ALPHA = frozenset({4, 6})
# Deflate cannot compress more than 1032 to 1.
_MAX_COMPRESSION = 1032
# The chunk that an animation is declared in comes before its pixels.
_ANIMATION_WITHIN_BYTES = 4096
_LOWER_CASE = 0x20  # of a chunk's first letter: the picture can be shown without it


def count_frames(stream: BinaryIO) -> int:
    """Return the number of pictures of an animated PNG, 1 for any other."""
    head = stream.read(_ANIMATION_WITHIN_BYTES)
    control = head.find(b"acTL", 0, head.find(b"IDAT"))
    if control < 0 or control + 8 > len(head):
        return 1
    return int(struct.unpack_from(">I", head, control + 4)[0])


def read_header(data: bytes) -> Header:
    """Return what a PNG declares, all its critical chunks checked; raises FrameError."""
    check_length(data, 33)
    if data[12:16] != b"IHDR":
        raise FrameError("damaged: the PNG does not begin with its header")
    width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
    pixel_bytes, turn, has_alpha = 0, 1, colour in _ALPHA
    place = len(SIGNATURE)
    while True:
        check_length(data, place + 12)
        length, kind = struct.unpack_from(">I4s", data, place)
        end = place + 12 + length
        check_length(data, end)
        if not kind[0] & _LOWER_CASE:
            (checksum,) = struct.unpack_from(">I", data, end - 4)
            if zlib.crc32(memoryview(data)[place + 4 : end - 4]) != checksum:
                raise FrameError("damaged: a checksum of the PNG does not match its data")
        if kind == b"IDAT":
            pixel_bytes += length
        elif kind == b"eXIf":
            turn = orientation(data[place + 8 : end - 4])
        elif kind == b"tRNS":  # of some colours
            has_alpha = True
        elif kind == b"IEND":
            break
        place = end
    header = Header(width, height, bits, turn, has_alpha)
    row_bytes = (width * bits * _SAMPLES.get(colour, 1) + 7) // 8
    if row_bytes * height > _MAX_COMPRESSION * pixel_bytes:
        raise truncated()
    return header
