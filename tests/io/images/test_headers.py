"""Headers are checked before a byte is decoded, and each foreign file is named."""

from __future__ import annotations

import io
import os
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from slamcli.core.errors import FrameError
from slamcli.io.frames import (
    list_frames,
    of_camera,
    read_frame,
    read_image,
    read_reduced_gray,
    read_size,
)
from slamcli.io.images import decoding
from slamcli.io.images.header import Header

PICTURE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)


def encoded(suffix: str, image: np.ndarray = PICTURE) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def reason_of(path: Path) -> str:
    with pytest.raises(FrameError) as caught:
        read_image(path)
    text = str(caught.value)
    assert "\n" not in text
    return text


def reason(folder: Path, data: bytes, name: str = "x.jpg") -> str:
    (folder / name).write_bytes(data)
    return reason_of(folder / name)


@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"%!PS-Adobe-3.0 EPSF-3.0\n", "a PostScript file, not a picture"),
        (b"%PDF-1.7\n", "a PDF file, not a picture"),
        (b"\0\0\0\x20ftypavif", "AVIF"),
        (b"\0\0\0\x20ftypheic", "HEIC"),
        (b"\0\0\0\x20ftypisom", "video"),
        (b"8BPS\0\1", "Photoshop"),
        (b"\0\0\x80?\0\0\x90B", "not an image"),
        (b"P9\n1 1\n", "not an image"),
    ],
)
def test_a_foreign_file_is_named_and_never_decoded(
    tmp_path: Path, start: bytes, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoding.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    assert kind in reason(tmp_path, start + bytes(500))


def test_the_hostile_files_have_a_reason(data_folder: Path) -> None:
    wanted = {
        "broken_alpha.png": "checksum",
        "broken_avif_named.jpg": "AVIF",
        "chunk_claims_4_gigabytes.png": "truncated",
        "damaged_middle.jpg": "a stretch of the file is zero",
        "header_claims_30000_pixels.jpg": "30000x30000",
        "postscript_named.jpg": "PostScript",
        "spider_named.jpg": "not an image",
    }
    for name, part in wanted.items():
        assert part in reason_of(data_folder / "hostile" / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_what_is_no_regular_file_is_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "zero.png").symlink_to("/dev/zero")
    for path in (tmp_path / "pipe.png", tmp_path / "zero.png", tmp_path):
        assert "not a file" in reason_of(path)


def test_a_file_that_is_too_large_is_not_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(decoding, "MAX_FILE_BYTES", 1000)
    assert "too large" in reason(tmp_path, bytes(1001))


def test_a_declared_size_has_a_limit(tmp_path: Path) -> None:
    def png(width: int, height: int) -> bytes:
        body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
        chunk = struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
        return encoded(".png")[:8] + chunk + encoded(".png")[33:]

    assert "too many to be decoded" in reason(tmp_path, png(30000, 30000))
    assert "truncated" in reason(tmp_path, png(9000, 9000))
    bmp = bytearray(encoded(".bmp"))
    bmp[18:26] = struct.pack("<ii", 40000, 40000)
    assert "40000x40000" in reason(tmp_path, bytes(bmp))
    assert "90000x90000" in reason(tmp_path, b"P5 90000 90000 255\n" + bytes(100))
    assert "truncated" in reason(tmp_path, b"P5 900 900 255\n" + bytes(100))
    jpeg = encoded(".jpg")
    place = jpeg.find(b"\xff\xc0") + 5
    wide = jpeg[:place] + struct.pack(">HH", 12000, 12000) + jpeg[place + 4 :]
    assert "truncated" in reason(tmp_path, wide)


def test_scans_over_many_pixels_are_bounded(tmp_path: Path) -> None:
    """Each is a pass over all blocks, whatever few bytes it has."""
    whole = io.BytesIO()
    Image.fromarray(PICTURE).save(whole, "JPEG", progressive=True)
    data = whole.getvalue()
    place, scan = data.find(b"\xff\xc2") + 5, data.rfind(b"\xff\xda")
    wide = data[:place] + struct.pack(">HH", 12000, 12000) + data[place + 4 : scan]
    wide += 30 * data[scan:-2] + bytes(1_000_000) + b"\xff\xd9"
    assert "more scans than any encoder writes" in reason(tmp_path, wide)


def test_tiles_have_the_limits_of_pictures(tmp_path: Path) -> None:
    tags = ((256, 64), (257, 48), (258, 8), (259, 1), (322, 60000), (323, 60000), (324, 8))
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    data = b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(5000)
    assert "60000x60000 pixels, too many" in reason(tmp_path, data)


def test_of_deep_samples_fewer_pixels_are_decoded() -> None:
    assert Header(9000, 9000).size == (9000, 9000)
    with pytest.raises(FrameError, match="9000x9000 pixels, too many"):
        Header(9000, 9000, sample_bits=16)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif", ".bmp", ".ppm", ".gif"])
def test_every_cut_and_every_changed_length_is_a_reason_or_a_picture(
    tmp_path: Path, suffix: str
) -> None:
    """The header of each format is walked at every place where the file may end."""
    whole = encoded(suffix)
    cuts = [whole[:n] for n in (*range(1, min(len(whole), 400)), *range(400, len(whole), 97))]
    rng = np.random.default_rng(1)
    for _ in range(300):
        data = bytearray(whole)
        data[rng.integers(4, min(len(data), 200))] = rng.integers(0, 256)
        cuts.append(bytes(data))
    path = tmp_path / "x.png"
    for data in cuts:
        path.write_bytes(data)
        with suppress(FrameError):
            read_image(path)


@pytest.mark.parametrize("code", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_every_orientation_is_applied(tmp_path: Path, suffix: str, code: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = code
    path = tmp_path / f"0.{suffix}"
    Image.fromarray(PICTURE).save(path, exif=exif, quality=95)
    np.testing.assert_array_equal(read_image(path), cv2.imread(str(path), cv2.IMREAD_COLOR_BGR))


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("code", [1, 3, 6])
def test_the_size_of_the_header_is_that_of_the_picture(
    tmp_path: Path, suffix: str, code: int
) -> None:
    exif = Image.Exif()
    exif[0x0112] = code
    path = tmp_path / f"0.{suffix}"
    Image.fromarray(PICTURE).save(path, exif=exif)
    image = read_image(path)
    assert read_size(path) == (image.shape[1], image.shape[0])
    assert (image.shape[0] > image.shape[1]) == (code == 6)


def test_a_picture_of_another_size_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "0.png").write_bytes(encoded(".png"))
    monkeypatch.setattr(decoding.cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    for read in (read_frame, read_reduced_gray):
        with pytest.raises(FrameError, match="64x48 pixels, but the run's camera has 640x480"):
            read(of_camera(list_frames([tmp_path]), (640, 480))[0])


TURNS = {
    1: lambda stored: stored,
    2: np.fliplr,
    3: lambda stored: np.rot90(stored, 2),
    4: np.flipud,
    5: lambda stored: np.swapaxes(stored, 0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: np.rot90(np.swapaxes(stored, 0, 1), 2),
    8: np.rot90,
}


def with_alpha(kind: str, alpha: np.ndarray) -> tuple[Image.Image, dict[str, object]]:
    """Return a picture with transparent pixels, and how it is saved."""
    if kind == "palette":
        return Image.fromarray(np.where(alpha, np.uint8(1), np.uint8(0)), "P"), {"transparency": 0}
    colours = Image.fromarray(np.dstack([PICTURE, alpha]))
    return colours.convert("LA" if kind == "gray" else "RGBA"), {"lossless": True}


@pytest.mark.parametrize("code", TURNS)
@pytest.mark.parametrize(
    ("suffix", "kind"),
    [("png", "colour"), ("png", "gray"), ("png", "palette"), ("webp", "colour"), ("tif", "colour")],
)
def test_a_turned_picture_turns_its_mask(tmp_path: Path, suffix: str, kind: str, code: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = code
    alpha = np.full((48, 64), 255, np.uint8)
    alpha[:20, :10] = 0
    image, options = with_alpha(kind, alpha)
    if kind == "palette":
        image.putpalette(bytes(range(6)))
    image.save(tmp_path / f"0.{suffix}", exif=exif, **options)
    expected = TURNS[code](alpha)
    for gray in (False, True):
        frame = read_frame(list_frames([tmp_path])[0], gray=gray)
        assert frame.mask is not None
        np.testing.assert_array_equal(frame.mask, expected)
        assert frame.image.shape[:2] == expected.shape
    if kind == "colour":
        seen = read_frame(list_frames([tmp_path])[0]).image
        pixels = TURNS[code](PICTURE)[..., ::-1]
        np.testing.assert_array_equal(seen[expected > 0], pixels[expected > 0])
