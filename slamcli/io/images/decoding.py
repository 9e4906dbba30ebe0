"""Decoding of a picture file: its format by content, its header checked, its damage looked for."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array, UInt16Array
from slamcli.core.errors import FrameError, other_size
from slamcli.io.images import formats, jpeg, plain, png, tiff, webp
from slamcli.io.images.exif import turn
from slamcli.io.images.header import Header
from slamcli.io.images.plain_rows import check_dead_rows, find_bars

MAX_FILE_BYTES = 512 * 1024**2
# The depths that cameras write into 16 bits.
CAMERA_BITS = (8, 10, 12, 14, 16)
# How libpng makes gray of colours, in 2 ** 15 ths of blue, green and red, without rounding.
_GRAY_SHARES = 3737, 19234, 9797
_KINDS = {
    (False, 1): cv2.IMREAD_COLOR_BGR,
    (False, 2): cv2.IMREAD_REDUCED_COLOR_2,
    (True, 1): cv2.IMREAD_GRAYSCALE,
    (True, 4): cv2.IMREAD_REDUCED_GRAYSCALE_4,
}
_HEADERS = {
    formats.PNG: png.read_header,
    formats.WEBP: webp.read_header,
    formats.TIFF: tiff.read_header,
    formats.BMP: plain.read_bmp_header,
    formats.PNM: plain.read_pnm_header,
    formats.GIF: plain.read_gif_header,
}
_DEAD_STRETCHES = {
    formats.WEBP: webp.check_dead_stretch,
    formats.TIFF: tiff.check_dead_stretch,
}
_PLAIN_ROWS = {
    formats.BMP: plain.bmp_rows,
    formats.PNM: plain.pnm_rows,
    formats.TIFF: tiff.tiff_rows,
}


@dataclass(frozen=True, slots=True)
class Reading:
    """How a picture is to be decoded.

    Attributes
    ----------
    gray : bool
        As (H, W) instead of (H, W, 3).
    factor : int
        By which each side is reduced: 1, 2 in colours, 4 in gray.
    sample_bits : int or None
        The range of samples of more than 8 bits; None for the range of this picture.
    camera_size : tuple of int or None
        Width and height that the picture must have, before a pixel of it is decoded.
    """

    gray: bool = False
    factor: int = 1
    sample_bits: int | None = None
    camera_size: tuple[int, int] | None = None


def read_bytes(path: Path) -> bytes:
    """Return the content of a regular file of a picture's size; raises FrameError."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise FrameError("cannot be read: it is not a file (a folder, a pipe or a device)")
        if status.st_size > MAX_FILE_BYTES:
            raise FrameError(f"a file of {status.st_size / 1e6:.0f} MB is too large for a picture")
        with path.open("rb") as stream:
            data = stream.read(MAX_FILE_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else None
        raise FrameError(f"cannot be read: {reason or error}") from error
    if not data:
        raise FrameError("the file is empty (0 bytes)")
    return data


def decode(data: bytes, reading: Reading) -> tuple[UInt8Array, UInt8Array | None]:
    """Return the picture as it is to be seen, and its mask of opaque pixels if it hides some.

    Raises
    ------
    FrameError
        When it is of no format that is read, too large or too small, damaged or cut.
    """
    kind = formats.format_of(data)
    if kind == formats.JPEG:
        segments = jpeg.read_header(data)
        _check_size(segments.header, reading)
        image = jpeg.decode(data, segments, gray=reading.gray, factor=reading.factor)
        return turn(image, segments.header.orientation), None
    header = _HEADERS[kind](data)
    _check_size(header, reading)
    if kind in _DEAD_STRETCHES:
        _DEAD_STRETCHES[kind](data)
    bars = _bars(kind, data, header)
    # OpenCV turns every TIFF, and no other file here.
    code = 1 if kind == formats.TIFF else header.orientation
    mask = _transparency(data) if header.has_alpha else None
    image = turn(_decoded(kind, data, header, reading), code)
    mask = None if mask is None else turn(mask, code)
    bars = None if bars is None else turn(bars, header.orientation)
    if mask is None or bars is None:
        return image, bars if mask is None else mask
    return image, np.minimum(mask, bars)


def _bars(kind: str, data: bytes, header: Header) -> UInt8Array | None:
    """Return a mask, as stored, without the bars across a picture without compression, if any.

    Raises
    ------
    FrameError
        When a stretch of it is dead.
    """
    plain_of = _PLAIN_ROWS.get(kind)
    found = None if plain_of is None else plain_of(data)
    if found is None:
        return None
    check_dead_rows(found)
    bars = find_bars(found)
    if not bars.any() or len(bars) != header.height:
        return None
    if kind == formats.BMP and plain.is_bottom_up(data):
        bars = bars[::-1]
    rows = np.where(bars, np.uint8(0), np.uint8(255))
    return np.repeat(rows[:, None], header.width, axis=1)


def from_pixels(pixels: UInt8Array, reading: Reading) -> UInt8Array:
    """Return decoded pixels, (H, W) gray or (H, W, 3) BGR, as a PNG of them would be read.

    Raises
    ------
    FrameError
    """
    size = pixels.shape[1], pixels.shape[0]
    _check_size(Header(*size), reading)
    if reading.gray and pixels.ndim == 3:
        # Rounded down: half a level less, so that no value lies between two.
        row = [*(share / 2**15 for share in _GRAY_SHARES), 2**-16 - 0.5]
        pixels = np.asarray(cv2.transform(pixels, np.array([row])), np.uint8)
    elif not reading.gray and pixels.ndim == 2:
        pixels = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR), np.uint8)
    return _reduced(pixels, reading.factor)


def picture_size(data: bytes) -> tuple[int, int]:
    """Return the width and height that the header declares, pixels, turned; raises FrameError."""
    kind = formats.format_of(data)
    return (jpeg.read_header(data).header if kind == formats.JPEG else _HEADERS[kind](data)).size


def _check_size(header: Header, reading: Reading) -> None:
    if reading.camera_size not in {None, header.size}:
        raise other_size(header.size, reading.camera_size)


def sample_bits(data: bytes) -> int | None:
    """Return the range of samples of more than 8 bits as a camera's depth; None for other pictures.

    Raises
    ------
    FrameError
    """
    kind = formats.format_of(data)
    if kind == formats.JPEG or _HEADERS[kind](data).sample_bits <= 8:
        return None
    return _range_bits(_deep(data, cv2.IMREAD_COLOR_BGR))


def _decoded(kind: str, data: bytes, header: Header, reading: Reading) -> UInt8Array:
    """Return the picture as it is stored, a TIFF as it is to be seen."""
    whole = _KINDS[reading.gray, 1]
    if header.sample_bits > 8:
        deep = _deep(data, whole)
        bits = reading.sample_bits or _range_bits(deep)
        if bits < 16:
            # In place: a picture may be large.
            np.minimum(np.right_shift(deep, bits - 8, out=deep), 255, out=deep)
            return _reduced(deep.astype(np.uint8), reading.factor)
    if kind == formats.TIFF and header.size != (header.width, header.height):
        # OpenCV reduces a picture to the sides that it had before it was turned.
        return _reduced(np.asarray(_opencv(data, whole), dtype=np.uint8), reading.factor)
    return np.asarray(_opencv(data, _KINDS[reading.gray, reading.factor]), dtype=np.uint8)


def _reduced(image: UInt8Array, factor: int) -> UInt8Array:
    if factor == 1:
        return image
    size = image.shape[1] // factor, image.shape[0] // factor
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT), dtype=np.uint8)


def _deep(data: bytes, kind: int) -> UInt16Array:
    return np.asarray(_opencv(data, kind | cv2.IMREAD_ANYDEPTH), dtype=np.uint16)


def _range_bits(samples: UInt16Array) -> int:
    bits = int(samples.max()).bit_length()
    return next(depth for depth in CAMERA_BITS if bits <= depth)


def _opencv(data: bytes, kind: int) -> UInt8Array | UInt16Array:
    """Decode by OpenCV, whose decoder is that of the format; raises FrameError."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), kind | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise FrameError(f"the decoder refuses it: {error.err}") from error
    if image is None:
        raise FrameError("damaged: the decoder cannot read its data")
    return image  # type: ignore[return-value]


def _transparency(data: bytes) -> UInt8Array | None:
    """Return the alpha channel as it is stored, of a TIFF as it is to be seen, if it hides some."""
    decoded = _opencv(data, cv2.IMREAD_UNCHANGED)
    if decoded.ndim != 3 or decoded.shape[2] != 4:
        return None
    alpha = decoded[..., 3]
    opaque = alpha == (65535 if alpha.dtype == np.uint16 else 255)
    return None if opaque.all() else np.where(opaque, np.uint8(255), np.uint8(0))
