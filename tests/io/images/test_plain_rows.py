"""Uncompressed pictures carry no check: what a dead stretch looks like, and what does not."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("PIL")

from PIL import Image

from slamcli.core.errors import FrameError
from slamcli.io.frames import list_frames, read_frame, read_image

HEIGHT, WIDTH = 240, 320
SUFFIXES = (".bmp", ".pnm", ".tif")


def floor() -> np.ndarray:
    rng = np.random.default_rng(2)
    coarse = rng.integers(40, 200, (12, 16, 3), np.uint8)
    return np.asarray(cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)


def encoded(image: np.ndarray, suffix: str) -> bytes:
    if suffix == ".tif":
        stream = BytesIO()
        Image.fromarray(image).save(stream, "TIFF")
        return stream.getvalue()
    return cv2.imencode(suffix, image)[1].tobytes()


def read(path: Path, data: bytes) -> np.ndarray:
    path.write_bytes(data)
    return read_image(path)


def with_joint(rise: float, value: int) -> np.ndarray:
    """Return a floor with a joint across the picture, rendered without smoothing, and one along."""
    image = floor()
    image[:, 100:104] = value
    rows = np.arange(HEIGHT)[:, None] - rise * np.arange(WIDTH) / WIDTH
    image[(rows > 100.5) & (rows < 120.5)] = value
    return image


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("gray", [False, True])
@pytest.mark.parametrize("byte", [b"\0", b"\xff"])
@pytest.mark.parametrize("end", ["within", "half written"])
def test_a_dead_stretch_is_damage(
    tmp_path: Path, suffix: str, gray: bool, byte: bytes, end: str
) -> None:
    image = cv2.cvtColor(floor(), cv2.COLOR_BGR2GRAY) if gray else floor()
    data = bytearray(encoded(image, suffix))
    assert read(tmp_path / f"0{suffix}", bytes(data)).shape == (HEIGHT, WIDTH, 3)
    start = len(data) // 2 + 100
    count = 7777 if end == "within" else len(data) - start
    data[start : start + count] = byte * count
    with pytest.raises(FrameError, match="damaged: a stretch of the file is"):
        read(tmp_path / f"1{suffix}", bytes(data))


GOOD: dict[str, Callable[[int], np.ndarray]] = {
    "flat": lambda value: np.full((HEIGHT, WIDTH, 3), value, np.uint8),
    "letterbox": lambda value: np.vstack([np.full((30, WIDTH, 3), value, np.uint8), floor()[30:]]),
    "half": lambda value: np.vstack([floor()[:120], np.full((120, WIDTH, 3), value, np.uint8)]),
    "level joint": lambda value: with_joint(0.0, value),
    "joint that rises by a row": lambda value: with_joint(1.0, value),
    "joint that falls by a row": lambda value: with_joint(-1.0, value),
    "steep joint": lambda value: with_joint(9.0, value),
}


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("value", [0, 255])
@pytest.mark.parametrize("make", GOOD.values(), ids=GOOD)
def test_black_and_white_floors_are_none(
    tmp_path: Path, suffix: str, value: int, make: Callable[[int], np.ndarray]
) -> None:
    image = make(value)
    found = read(tmp_path / f"0{suffix}", encoded(image, suffix))
    np.testing.assert_array_equal(found, image[..., ::-1] if suffix == ".tif" else image)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("code", [1, 6])
def test_a_bar_across_the_picture_is_no_floor(tmp_path: Path, suffix: str, code: int) -> None:
    image = floor()
    image[-60:] = 0
    data = encoded(image, suffix)
    if suffix == ".tif":
        stream = BytesIO()
        Image.fromarray(image).save(stream, "TIFF", tiffinfo={274: code})
        data = stream.getvalue()
    path = tmp_path / f"0{suffix}"
    path.write_bytes(data)
    mask = read_frame(list_frames([path])[0], gray=True).mask
    assert mask is not None
    expected = np.full((HEIGHT, WIDTH), 255, np.uint8)
    # The row beside a bar may belong to it in part.
    expected[-61:] = 0
    turned = code == 6 and suffix == ".tif"
    np.testing.assert_array_equal(mask, np.rot90(expected, -1) if turned else expected)


def test_black_floor_is_no_bar(tmp_path: Path) -> None:
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.line(image, (20, 100), (300, 120), 255, 9)
    path = tmp_path / "0.bmp"
    path.write_bytes(encoded(image, ".bmp"))
    assert read_frame(list_frames([path])[0]).mask is None


def test_a_text_of_pixels_with_zero_bytes_is_damaged(tmp_path: Path) -> None:
    text = bytearray(b"P2 20 20 255 " + b"17 " * 400)
    read(tmp_path / "0.pgm", bytes(text))
    text[200:260] = bytes(60)
    with pytest.raises(FrameError, match="a stretch of the file is zero"):
        read(tmp_path / "1.pgm", bytes(text))
