"""The orientation of a picture, from its EXIF block."""

from __future__ import annotations

import struct

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array

_ORIENTATION_TAG = 0x0112
_SHORT = 3
# What a JPEG has before the block, and a WebP may have.
EXIF_START = b"Exif\0\0"


def orientation(block: bytes) -> int:
    """Return the EXIF orientation code, 1 to 8, of a TIFF-like block; 1 when it has none."""
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None:
        return 1
    try:
        (offset,) = struct.unpack_from(f"{order}I", block, 4)
        (count,) = struct.unpack_from(f"{order}H", block, offset)
        for entry in range(offset + 2, offset + 2 + 12 * count, 12):
            tag, kind = struct.unpack_from(f"{order}HH", block, entry)
            if tag == _ORIENTATION_TAG and kind == _SHORT:
                (code,) = struct.unpack_from(f"{order}H", block, entry + 8)
                return code if 1 <= code <= 8 else 1
    except struct.error:  # the block is cut: the picture is shown as it is stored
        return 1
    return 1


def turn(image: UInt8Array, code: int) -> UInt8Array:
    """Return a picture turned and mirrored as its EXIF orientation code says."""
    if code >= 5:
        image = np.asarray(cv2.transpose(image), dtype=np.uint8)
    flip = {2: 1, 3: -1, 4: 0, 6: 1, 7: -1, 8: 0}.get(code)
    return image if flip is None else np.asarray(cv2.flip(image, flip), dtype=np.uint8)
