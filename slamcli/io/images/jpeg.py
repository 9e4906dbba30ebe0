"""JPEG files: segments checked against the file, decoding by libjpeg with its warnings read.

OpenCV decodes a picture with a damaged scan without any error. simplejpeg uses the same library,
gives the same pixels in the same time [benchmarks/damaged_pictures.py], and reports its warnings.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import simplejpeg

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import FrameError
from slamcli.io.images.exif import EXIF_START, orientation
from slamcli.io.images.header import Header, check_length, truncated

END = b"\xff\xd9"
_SCAN = b"\xff\xda"
_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_ARITHMETIC_MARKERS = frozenset(range(0xC9, 0xD0))
_PROGRESSIVE = 0xC2
_TABLES, _APP1, _START_OF_SCAN = 0xC4, 0xE1, 0xDA
_AC_TABLE = 1
# Zero bits are a run of coefficients of -1 where the first code of the luma table is not the end of
# a block: 24 zero bytes would fill a block, which no floor does. A progressive scan of AC has no
# two ends in a row, as they are counted; its refinement may repeat 1000 zero bits in drawn
# pictures. [guarded by benchmarks/damaged_pictures.py]
_MIN_DEAD_BYTES, _MIN_DEAD_REFINEMENT_BYTES = 48, 512
_ZEROS = re.compile(rb"\0{%d,}" % _MIN_DEAD_BYTES)
# Erased memory: in a scan, a byte of ones is followed by zero or a marker, which may be padded.
_ERASED = re.compile(rb"\xff{16,}[^\xff\xd9]")
# Cameras pad the data before the end marker; a damaged scan leaves hundreds of bytes
# [guarded by benchmarks/damaged_pictures.py].
_MAX_EXTRA_BYTES = 16
_MAX_PADDING_BYTES = 512
_EXTRA = re.compile(r"(\d+) extraneous bytes before marker 0xd9")
_DAMAGE = ("Corrupt JPEG data", "Premature end")
# A block of 8x8 pixels takes one bit or more of each scan that has its first coefficient.
_MAX_PIXELS_PER_BYTE = 512
# Each scan of a progressive picture costs a pass over all blocks; encoders write about ten.
_MAX_SCANS, _MAX_SCANNED_PIXELS = 200, 3_000_000_000


@dataclass(frozen=True, slots=True)
class JpegHeader:
    """The segments of a JPEG before its first scan.

    Attributes
    ----------
    header : Header
    components : int
        1 gray, 3 colour, 4 CMYK.
    scan_offset : int
        Where the first scan's data begin, bytes.
    progressive : bool
    zero_is_flat : bool
        Whether a stretch of zero bytes may be what flat blocks of the first scan are coded as.
    """

    header: Header
    components: int
    scan_offset: int
    progressive: bool
    zero_is_flat: bool


def read_header(data: bytes) -> JpegHeader:
    """Return what the segments before the first scan declare; raises FrameError."""
    frame: tuple[int, bytes] | None = None
    turn = 1
    first_symbols: dict[int, int] = {}
    for marker, body, end in _segments(data):
        if marker in _FRAME_MARKERS:
            frame = marker, body
        elif marker == _TABLES:
            first_symbols |= _first_ac_symbols(body)
        elif marker == _APP1 and body.startswith(EXIF_START):
            turn = orientation(body.removeprefix(EXIF_START))
        elif marker == _START_OF_SCAN:
            if frame is None:
                break
            return _header(data, frame, (body, end), turn, first_symbols)
    raise FrameError("damaged: a JPEG without a picture in it")


def decode(data: bytes, jpeg: JpegHeader, *, gray: bool, factor: int) -> UInt8Array:
    """Return the stored picture as BGR or gray, reduced by `factor`; raises FrameError.

    Raises
    ------
    FrameError
        When libjpeg warns of damage, or a stretch of the scan is zero.
    """
    _check_dead_stretch(data, jpeg)
    space = "CMYK" if jpeg.components == 4 else "GRAY" if gray else "BGR"
    sides = (-(-jpeg.header.height // factor), -(-jpeg.header.width // factor))
    least = sides if factor > 1 else (0, 0)
    try:
        image = simplejpeg.decode_jpeg(data, space, min_height=least[0], min_width=least[1])
    except ValueError as error:
        whole = _without_harm(data, str(error))
        image = _decode_leniently(whole, space, least)
    if jpeg.components == 4:
        return _decode_cmyk(data, gray=gray, factor=factor)
    return np.asarray(image[..., 0] if gray else image, dtype=np.uint8)


def _segments(data: bytes) -> Iterator[tuple[int, bytes, int]]:
    """Yield marker, body and end of each segment to the first scan's header; raises FrameError."""
    place = 2
    while True:
        check_length(data, place + 4)
        if data[place] != 0xFF:
            raise FrameError("damaged: a segment of the JPEG has a wrong length")
        marker = data[place + 1]
        if marker == 0xFF:  # a fill byte
            place += 1
            continue
        if marker == END[1]:
            return
        if marker == 0x01 or 0xD0 <= marker <= 0xD8:  # these have no body
            place += 2
            continue
        (length,) = struct.unpack_from(">H", data, place + 2)
        end = place + 2 + length
        check_length(data, end)
        yield marker, data[place + 4 : end], end
        if marker == _START_OF_SCAN:
            return
        place = end


def _first_ac_symbols(body: bytes) -> dict[int, int]:
    """Return for each AC table of a segment the symbol whose code is all zeros."""
    found: dict[int, int] = {}
    while len(body) > 17:
        count = sum(body[1:17])
        if body[0] >> 4 == _AC_TABLE and count and len(body) > 17:
            found[body[0] & 15] = body[17]
        body = body[17 + count :]
    return found


def _header(
    data: bytes,
    frame: tuple[int, bytes],
    scan: tuple[bytes, int],
    turn: int,
    first_symbols: dict[int, int],
) -> JpegHeader:
    marker, body = frame
    if len(body) < 6 or len(scan[0]) < 3:
        raise FrameError("damaged: a segment of the JPEG has a wrong length")
    bits, height, width, components = struct.unpack_from(">BHHB", body)
    if bits != 8:
        raise FrameError(f"a JPEG of {bits} bits a sample cannot be read; save it as PNG")
    header = Header(width, height, orientation=turn)
    if width * height > _MAX_PIXELS_PER_BYTE * len(data):
        raise truncated()
    scans = data.count(_SCAN, scan[1]) if marker == _PROGRESSIVE else 0
    if scans > min(_MAX_SCANS, _MAX_SCANNED_PIXELS // (width * height)):
        raise FrameError("damaged: the JPEG has more scans than any encoder writes")
    # Other codes than Huffman's and scans of the luma alone have their own meaning of zeros.
    # Without tables the standard ones hold, whose first luma symbol is 1.
    opaque = marker in _ARITHMETIC_MARKERS or scan[0][0] != components
    symbol = first_symbols.get(scan[0][2] & 15, 1)
    return JpegHeader(header, components, scan[1], marker == _PROGRESSIVE, opaque or symbol == 0)


def _check_dead_stretch(data: bytes, jpeg: JpegHeader) -> None:
    """Raise FrameError when a stretch of a scan is zeros or ones and no padding before the end."""
    if data.find(b"\0" * _MIN_DEAD_BYTES, jpeg.scan_offset) >= 0:
        end = data.find(END, jpeg.scan_offset)
        scans = data if end < 0 else data[:end].rstrip(b"\0")
        for zeros in _ZEROS.finditer(scans, jpeg.scan_offset):
            if len(zeros[0]) >= _dead_bytes(data, jpeg, zeros.start()):
                raise FrameError("damaged: a stretch of the file is zero")
    if data.find(b"\xff" * 16, jpeg.scan_offset) >= 0:
        end = data.find(END, jpeg.scan_offset)
        if _ERASED.search(data, jpeg.scan_offset, len(data) if end < 0 else end):
            raise FrameError("damaged: a stretch of the file is erased (bytes of ones)")


def _dead_bytes(data: bytes, jpeg: JpegHeader, offset: int) -> float:
    """Return the least count of zero bytes at an offset that no picture is coded as."""
    if not jpeg.progressive:
        return math.inf if jpeg.zero_is_flat else _MIN_DEAD_BYTES
    scan = data.rfind(_SCAN, 0, offset) + 4
    bands = scan + 1 + 2 * data[scan]
    if data[bands] == 0:  # the first coefficients: flat floors have zeros here
        return math.inf
    is_refinement = data[bands + 2] >> 4
    return _MIN_DEAD_REFINEMENT_BYTES if is_refinement else _MIN_DEAD_BYTES


def _without_harm(data: bytes, warning: str) -> bytes:
    """Return the data to decode when a warning is harmless; raises FrameError when it is not."""
    if warning.startswith("Premature end of JPEG file"):
        # Some cameras leave the end marker out: with it, nothing else may be missing.
        try:
            simplejpeg.decode_jpeg(data + END, "GRAY", min_height=1, min_width=1)
        except ValueError as error:
            raise truncated() from error
        return data + END
    match = _EXTRA.search(warning)
    if match:
        count = int(match[1])
        end = data.rfind(END)
        padding = data[max(end - count, 0) : end]
        if count <= _MAX_EXTRA_BYTES or (count <= _MAX_PADDING_BYTES and len(set(padding)) == 1):
            return data
    if warning.startswith(_DAMAGE):
        fault = warning.removeprefix("Corrupt JPEG data: ")
        raise FrameError(f"damaged: the decoder reports {fault}")
    return data


def _decode_leniently(data: bytes, space: str, least: tuple[int, int]) -> UInt8Array:
    try:
        image = simplejpeg.decode_jpeg(
            data, space, min_height=least[0], min_width=least[1], strict=False
        )
    except ValueError as error:
        raise FrameError(f"the decoder refuses it: {error}") from error
    return np.asarray(image, dtype=np.uint8)


def _decode_cmyk(data: bytes, *, gray: bool, factor: int) -> UInt8Array:
    """Decode by OpenCV, which converts the inks; damage has been looked for before."""
    kinds = {
        (False, 1): cv2.IMREAD_COLOR_BGR,
        (False, 2): cv2.IMREAD_REDUCED_COLOR_2,
        (True, 1): cv2.IMREAD_GRAYSCALE,
        (True, 4): cv2.IMREAD_REDUCED_GRAYSCALE_4,
    }
    kind = kinds[gray, factor] | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), kind)
    if image is None:
        raise FrameError("the decoder refuses it: no picture comes out")
    return np.asarray(image, dtype=np.uint8)
