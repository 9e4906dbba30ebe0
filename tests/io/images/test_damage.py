"""Damaged pictures are noticed, and plain, dark or flat ones are not taken for damaged."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from slamcli.core.errors import FrameError
from slamcli.io.frames import list_frames, read_frame, read_image, read_reduced_gray
from slamcli.io.images import tiff

SIZE = (480, 640)


def textured() -> np.ndarray:
    rng = np.random.default_rng(3)
    levels = [rng.normal(0, 1, (SIZE[0] // n, SIZE[1] // n, 3)) for n in (40, 10, 4, 1)]
    layers = [cv2.resize(level, SIZE[::-1], interpolation=cv2.INTER_CUBIC) for level in levels]
    image = 128 + 30 * layers[0] + 20 * layers[1] + 10 * layers[2] + 3 * layers[3]
    return np.clip(image, 0, 255).astype(np.uint8)


def encoded(kind: str, image: np.ndarray, **options: object) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, kind, **options)
    return stream.getvalue()


def reason(path: Path, data: bytes) -> str:
    path.write_bytes(data)
    (file,) = list_frames([path])
    texts = []
    for read in (lambda: read_image(path), lambda: read_frame(file, gray=True)):
        with pytest.raises(FrameError) as caught:
            read()
        texts.append(str(caught.value))
    for read in (lambda: read_frame(file, halved=True), lambda: read_reduced_gray(file)):
        with pytest.raises(FrameError):
            read()
    assert texts[0] == texts[1]
    return texts[0]


def decoded(data: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_BGR)


def zeroed(data: bytes, start: float, share: float) -> bytes:
    first, count = int(len(data) * start), int(len(data) * share)
    return data[:first] + bytes(count) + data[first + count :]


KINDS = {
    "plain": {},
    "progressive": {"progressive": True},
    "optimised": {"optimize": True},
    "restarts": {"restart_marker_rows": 1},
    "gray": {},
    "inks": {},
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start", [0.3, 0.5, 0.74])
def test_a_zeroed_stretch_of_a_jpeg_is_damage(tmp_path: Path, kind: str, start: float) -> None:
    image = textured()
    if kind == "gray":
        image = image[..., 0]
    if kind == "inks":
        image = np.asarray(Image.fromarray(image).convert("CMYK"))
        picture = Image.fromarray(image, "CMYK")
        stream = io.BytesIO()
        picture.save(stream, "JPEG", quality=90)
        data = stream.getvalue()
    else:
        data = encoded("JPEG", image, quality=90, **KINDS[kind])
    assert reason(tmp_path / "0.jpg", zeroed(data, start, 0.25)).startswith("damaged: ")


@pytest.mark.parametrize("kind", ["plain", "progressive", "optimised", "restarts"])
def test_an_erased_stretch_of_a_jpeg_is_damage(tmp_path: Path, kind: str) -> None:
    data = encoded("JPEG", textured(), quality=90, **KINDS[kind])
    start, count = len(data) // 2, len(data) // 8
    erased = data[:start] + b"\xff" * count + data[start + count :]
    assert "bytes of ones" in reason(tmp_path / "0.jpg", erased)
    padded = data[:-2] + b"\xff" * 100 + data[-2:]
    (tmp_path / "0.jpg").write_bytes(padded)
    np.testing.assert_array_equal(read_image(tmp_path / "0.jpg"), decoded(data))


def test_zeros_in_the_last_scan_of_a_progressive_jpeg_are_damage(tmp_path: Path) -> None:
    """The decoder is silent: they leave the last bit of the coefficients as it is."""
    data = encoded("JPEG", textured(), quality=75, progressive=True)
    start = data.rfind(b"\xff\xda") + 2000
    changed = data[:start] + bytes(1200) + data[start + 1200 :]
    assert "is zero" in reason(tmp_path / "0.jpg", changed)


@pytest.mark.parametrize("kind", ["plain", "progressive", "optimised", "restarts"])
def test_a_jpeg_cut_with_its_end_put_back_is_damage(tmp_path: Path, kind: str) -> None:
    data = encoded("JPEG", textured(), quality=90, **KINDS[kind])
    cut = data[: int(len(data) * 0.7)] + b"\xff\xd9"
    assert reason(tmp_path / "0.jpg", cut).startswith("damaged: ")
    assert "truncated" in reason(tmp_path / "0.jpg", data[: int(len(data) * 0.7)])


@pytest.mark.parametrize("method", [0, 4, 6])
@pytest.mark.parametrize("start", [0.02, 0.3, 0.5, 0.74])
def test_a_zeroed_stretch_of_a_webp_is_damage(tmp_path: Path, method: int, start: float) -> None:
    data = encoded("WEBP", textured(), quality=80, method=method)
    path = tmp_path / "0.webp"
    assert reason(path, zeroed(data, start, 0.25)).startswith("damaged: ")
    assert "truncated" in reason(path, data[: int(len(data) * 0.7)])


@pytest.mark.parametrize("byte", [b"\0", b"\xff"])
@pytest.mark.parametrize("method", ["tiff_adobe_deflate", "tiff_lzw", "packbits"])
def test_a_dead_stretch_of_a_compressed_tiff_is_damage(
    tmp_path: Path, method: str, byte: bytes
) -> None:
    data = encoded("TIFF", textured(), compression=method)
    start, count = len(data) // 3, len(data) // 10
    changed = data[:start] + count * byte + data[start + count :]
    assert reason(tmp_path / "0.tif", changed).startswith("damaged: ")


def test_what_inflates_without_end_is_cut_at_the_size_of_the_picture() -> None:
    bomb = zlib.compress(bytes(10_000_000), 9)
    assert tiff._inflates(bomb, 10_000_001)
    assert not tiff._inflates(bomb, 1_000_000)


def test_an_unknown_compression_of_a_tiff_is_a_reason(tmp_path: Path) -> None:
    """OpenCV gives a black picture."""
    data = encoded("TIFF", textured(), compression="tiff_lzw")
    place = data.find(struct.pack("<HHI", 259, 3, 1)) + 8
    changed = data[:place] + struct.pack("<H", 30444) + data[place + 2 :]
    assert "compression 30444" in reason(tmp_path / "0.tif", changed)


def test_a_png_with_a_changed_byte_is_damage(tmp_path: Path) -> None:
    data = bytearray(encoded("PNG", textured()))
    data[len(data) // 2] ^= 1
    assert "checksum" in reason(tmp_path / "0.png", bytes(data))


def plain_pictures() -> dict[str, np.ndarray]:
    black = np.zeros((*SIZE, 3), np.uint8)
    half = black.copy()
    half[:240] = textured()[:240]
    lower = black + np.uint8(90)
    lower[240:] = textured()[240:]
    ramp = np.tile(np.linspace(255, 0, SIZE[1]).astype(np.uint8)[None, :, None], (SIZE[0], 1, 3))
    lines = black + np.uint8(120)
    lines[::64], lines[:, ::64] = 230, 230
    squares = np.where((np.indices(SIZE).sum(0) // 8) % 2, 255, 0).astype(np.uint8)
    return {
        "black": black,
        "gray": black + np.uint8(128),
        "white": black + np.uint8(255),
        "half": half,
        "lower half": lower,
        "ramp": ramp,
        "lines": lines,
        "squares": np.dstack([squares] * 3),
        "dark": textured() // 32,
        "textured": textured(),
    }


@pytest.mark.parametrize("name", plain_pictures())
def test_no_good_picture_is_damage(tmp_path: Path, name: str) -> None:
    image = plain_pictures()[name]
    files = {
        f"{kind}{quality}.jpg": encoded("JPEG", image, quality=quality, **KINDS[kind])
        for kind in ("plain", "progressive", "optimised", "restarts")
        for quality in (20, 75, 95)
    }
    files |= {
        f"{method}{quality}.webp": encoded("WEBP", image, quality=quality, method=method)
        for method, quality in ((0, 75), (4, 20), (4, 100))
    }
    for method in (None, "tiff_adobe_deflate", "tiff_lzw", "packbits"):
        files[f"{method}.tif"] = encoded("TIFF", image, compression=method)
    files["lossless.webp"] = encoded("WEBP", image, lossless=True)
    files["gray.jpg"] = encoded("JPEG", image[..., 0], optimize=True)
    for file, data in files.items():
        path = tmp_path / file
        path.write_bytes(data)
        np.testing.assert_array_equal(read_image(path), cv2.imread(str(path)))


def test_padding_and_a_missing_end_marker_are_no_damage(tmp_path: Path) -> None:
    """Cameras write such files, with a picture that is whole."""
    data = encoded("JPEG", textured(), quality=90)
    path = tmp_path / "0.jpg"
    path.write_bytes(data)
    whole = read_image(path)
    for harmless in (
        data[:-2],
        data[:-2] + bytes(200) + data[-2:],
        data[:-2] + b"\x12\x34\x56" + data[-2:],
        data + b"a trailer of a camera",
        data + bytes(1000),
    ):
        path.write_bytes(harmless)
        np.testing.assert_array_equal(read_image(path), whole)


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_pixels_are_those_of_opencv(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "0.jpg"
    path.write_bytes(encoded("JPEG", textured()[:477, :635], **options))
    (file,) = list_frames([path])
    for kind, image in (
        (cv2.IMREAD_COLOR_BGR, read_frame(file).image),
        (cv2.IMREAD_GRAYSCALE, read_frame(file, gray=True).image),
        (cv2.IMREAD_REDUCED_COLOR_2, read_frame(file, halved=True).image),
        (cv2.IMREAD_REDUCED_GRAYSCALE_4, read_reduced_gray(file)),
    ):
        np.testing.assert_array_equal(image, cv2.imread(str(path), kind))
