"""The formats that are read, known by their first bytes, and the names of those that are not."""

from __future__ import annotations

import re

from slamcli.core.errors import FrameError
from slamcli.io.images import png, tiff, webp

JPEG, PNG, WEBP, TIFF, BMP, PNM, GIF = "JPEG", "PNG", "WebP", "TIFF", "BMP", "PNM", "GIF"
_PNM_START = re.compile(rb"P[1-6][\s#]")
_READ = (
    (b"\xff\xd8\xff", JPEG),
    (png.SIGNATURE, PNG),
    *((signature, TIFF) for signature in tiff.SIGNATURES),
    (b"BM", BMP),
    (b"GIF87a", GIF),
    (b"GIF89a", GIF),
)
_OTHER_PICTURES = (
    (b"\0\0\0\x0cjP  ", "JPEG 2000"),
    (b"\xff\x4f\xff\x51", "JPEG 2000"),
    (b"\xff\x0a", "JPEG XL"),
    (b"\0\0\0\x0cJXL ", "JPEG XL"),
    (b"8BPS", "Photoshop"),
    (b"v/1\x01", "OpenEXR"),
    (b"#?RADIANCE", "Radiance HDR"),
    (b"FUJIFILMCCD-RAW", "raw camera"),
)
_NO_PICTURES = (
    (b"%!PS", "PostScript"),
    (b"\xc5\xd0\xd3\xc6", "PostScript"),
    (b"%PDF", "PDF"),
    (b"PK\x03\x04", "ZIP"),
    (b"\x1f\x8b", "gzip"),
    (b"<svg", "SVG"),
    (b"<?xml", "XML"),
    (b"<!DOCTYPE", "HTML"),
    (b"<html", "HTML"),
    (b"\x1aE\xdf\xa3", "Matroska video"),
    (b"\x7fELF", "program"),
    (b"\x89HDF", "HDF5"),
    (b"\x93NUMPY", "NumPy"),
)
# The brand of an ISO media file, at byte 8, after `ftyp`.
_BRANDS = {b"avif": "AVIF", b"avis": "AVIF", b"heic": "HEIC", b"heix": "HEIC", b"mif1": "HEIC"}


def format_of(data: bytes) -> str:
    """Return the format of a picture from its first bytes.

    Raises
    ------
    FrameError
        With the name of what it is instead, where that is known.
    """
    found = _among(data, _READ)
    if found:
        return found
    if webp.is_webp(data):
        return WEBP
    if _PNM_START.match(data):
        return PNM
    other = _among(data, _OTHER_PICTURES)
    if data[4:8] == b"ftyp":
        other = _BRANDS.get(data[8:12], "video")
    if other:
        raise FrameError(f"it is a file of the kind {other}, which is not read; save it as PNG")
    foreign = _among(data, _NO_PICTURES)
    if foreign:
        raise FrameError(f"it is a {foreign} file, not a picture")
    raise FrameError("not an image, or of a kind that cannot be read; save it as PNG or JPEG")


def _among(data: bytes, signatures: tuple[tuple[bytes, str], ...]) -> str:
    return next((name for start, name in signatures if data.startswith(start)), "")
