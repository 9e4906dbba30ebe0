"""A PNG from strips is the picture, to OpenCV, Pillow and zlib, which check the checksums."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from slamcli.io.raster import png


@pytest.mark.parametrize("cuts", [[], [1], [7, 64, 65]], ids=str)
def test_a_picture_in_strips_is_read_back(tmp_path: Path, cuts: list[int]) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (97, 131, 4), np.uint8)
    pixels[20:60] = 0
    parts = np.split(pixels, cuts)
    path = tmp_path / "a.png"
    png.write_png(path, 131, 97, (png.compress(part) for part in parts))
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), pixels)
    chunks, place, data = b"", 8, path.read_bytes()
    while place < len(data):
        length = int.from_bytes(data[place : place + 4])
        if data[place + 4 : place + 8] == b"IDAT":
            chunks += data[place + 8 : place + 8 + length]
        place += 12 + length
    assert len(zlib.decompress(chunks)) == 97 * (1 + 4 * 131), "the Adler-32 holds too"
    with Image.open(path) as opened:
        opened.verify()
    with Image.open(path) as opened:
        assert np.array_equal(np.asarray(opened)[..., [2, 1, 0, 3]], pixels)
    # Colours and opacity apart are the same bytes.
    for part in parts:
        colours, opacity = np.ascontiguousarray(part[..., :3]), np.ascontiguousarray(part[..., 3])
        assert png.compress(colours, opacity) == png.compress(part)
