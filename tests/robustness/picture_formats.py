"""The picture formats of the fuzzer: small good files of each, and what reading one promises."""

from __future__ import annotations

import io
import struct
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from fuzz import Format, SilentlyWrongError
from PIL import Image

from slamcli.core.errors import FrameError
from slamcli.io.containers.heic import can_read_heic
from slamcli.io.frames import (
    FrameFile,
    list_frames,
    read_frame,
    read_image,
    read_reduced_gray,
    read_size,
)
from slamcli.io.images.unread import unread_note

WIDTH, HEIGHT = 60, 46


def picture() -> np.ndarray:
    """Return a small textured picture, RGB."""
    noise = np.random.default_rng(1).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)


def encoded(kind: str, mode: str = "RGB", **options: object) -> bytes:
    """Return the picture as a file of a format."""
    stream = io.BytesIO()
    Image.fromarray(picture()).convert(mode).save(stream, kind, **options)
    return stream.getvalue()


def animated(kind: str, **options: object) -> bytes:
    """Return a file of three pictures."""
    pages = [Image.fromarray(picture() // n) for n in (1, 2, 3)]
    stream = io.BytesIO()
    pages[0].save(stream, kind, save_all=True, append_images=pages[1:], **options)
    return stream.getvalue()


def turned() -> Image.Exif:
    """Return an EXIF block with an orientation."""
    exif = Image.Exif()
    exif[0x0112] = 6
    return exif


def deep(suffix: str) -> bytes:
    """Return the picture with 12 bits in 16."""
    gray = cv2.cvtColor(picture(), cv2.COLOR_RGB2GRAY).astype(np.uint16) << 4
    return cv2.imencode(suffix, gray)[1].tobytes()


def jpegs() -> list[bytes]:
    return [
        encoded("JPEG"),
        encoded("JPEG", "L", optimize=True),
        encoded("JPEG", "CMYK"),
        encoded("JPEG", progressive=True),
        encoded("JPEG", restart_marker_rows=1, subsampling=0),
        encoded("JPEG", exif=turned()),
    ]


def pngs() -> list[bytes]:
    return [
        encoded("PNG"),
        encoded("PNG", "L"),
        encoded("PNG", "P"),
        encoded("PNG", "1"),
        encoded("PNG", "LA"),
        encoded("PNG", "RGBA", exif=turned()),
        animated("PNG"),
        deep(".png"),
    ]


def webps() -> list[bytes]:
    return [
        encoded("WEBP"),
        encoded("WEBP", lossless=True),
        encoded("WEBP", "RGBA", exif=turned()),
        encoded("WEBP", quality=10, method=0),
        animated("WEBP"),
    ]


def tiffs() -> list[bytes]:
    methods = ("tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg")
    return [
        encoded("TIFF"),
        encoded("TIFF", "1"),
        encoded("TIFF", "P"),
        *(encoded("TIFF", compression=method) for method in methods),
        encoded("TIFF", tiffinfo={274: 6}),
        encoded("TIFF", big_tiff=True),
        animated("TIFF"),
        deep(".tif"),
    ]


def bmps() -> list[bytes]:
    return [encoded("BMP", mode) for mode in ("RGB", "L", "P", "1")]


def pnms() -> list[bytes]:
    text = " ".join(map(str, picture().ravel().tolist()))
    return [
        *(encoded("PPM", mode) for mode in ("RGB", "L", "1")),
        f"P3\n# a comment\n{WIDTH} {HEIGHT}\n255\n{text}\n".encode(),
        f"P2 {WIDTH} {HEIGHT} 255 {text}".encode(),
        deep(".pgm"),
    ]


def gifs() -> list[bytes]:
    return [encoded("GIF", "P"), animated("GIF")]


def heics() -> list[bytes]:
    import pillow_heif

    found = []
    for mode in ("RGB", "L", "RGBA"):
        stream = io.BytesIO()
        whole = Image.fromarray(cv2.resize(picture(), (64, 64))).convert(mode)
        pillow_heif.from_pillow(whole).save(stream, quality=60)
        found.append(stream.getvalue())
    return found


def foreign() -> list[bytes]:
    kinds = (b"%!PS-Adobe-3.0\n", b"%PDF-1.7\n", b"PK\x03\x04", b"8BPS\0\1", b"\0\0\x80?\0\0\x90B")
    brands = (b"avif", b"heic", b"isom")
    starts = [*kinds, *(b"\0\0\0\x20ftyp" + brand for brand in brands)]
    return [start + random for start in starts for random in (bytes(300), picture().tobytes())]


def read_pages(files: list[FrameFile]) -> None:
    """Read the pages of a file: each is a picture of the size that it declares, or has a reason."""
    faults = []
    for file in files:
        width, height = file.size()
        try:
            image, gray = read_frame(file).image, read_frame(file, gray=True).image
        except FrameError as error:
            faults.append(error)
            continue
        expect(image.shape == (height, width, 3), "a page of another size than it declares")
        expect(gray.shape == (height, width), "gray or colour")
    if len(faults) == len(files):
        raise faults[0]


def read(path: Path) -> None:
    """Read a picture in every way, and compare the ways with one another."""
    files = list_frames([path])
    unread_note(files)
    file = files[0]
    if file.part is not None:
        read_pages(files)
        return
    try:
        image = read_image(path)
    except FrameError:
        for other in (read_frame, partial(read_frame, gray=True), read_reduced_gray):
            try:
                other(file)
            except FrameError:
                continue
            raise SilentlyWrongError("one way of reading refuses what another accepts") from None
        raise
    height, width = image.shape[:2]
    frame, gray = read_frame(file), read_frame(file, gray=True).image
    halved, reduced = read_frame(file, halved=True).image, read_reduced_gray(file)
    expect(image.dtype == np.uint8 and image.shape == (height, width, 3), "no BGR of 8 bits")
    expect(read_size(path) == (width, height), "the header's size is not the picture's")
    expect(frame.image.shape == image.shape and gray.shape == (height, width), "gray or colour")
    for small, factor in ((halved, 2), (reduced, 4)):
        sides = (factor * small.shape[0] - height, factor * small.shape[1] - width)
        expect(max(map(abs, sides)) < factor, f"1/{factor} of {width}x{height}: {small.shape}")
    expect(halved.ndim == 3 and reduced.ndim == 2, "halved in gray, or a quarter in colours")
    expect(frame.mask is None or frame.mask.shape == (height, width), "mask of another size")


def expect(promise: bool, text: str) -> None:
    """Raise SilentlyWrongError for a promise that is not held."""
    if not promise:
        raise SilentlyWrongError(text)


def with_png_checksums(data: bytes) -> bytes:
    """Return a PNG whose chunks have right checksums, as far as their lengths go."""
    changed, place = bytearray(data), 8
    while place + 12 <= len(changed):
        (length,) = struct.unpack_from(">I", changed, place)
        end = place + 12 + length
        if end > len(changed):
            break
        struct.pack_into(">I", changed, end - 4, zlib.crc32(changed[place + 4 : end - 4]))
        place = end
    return bytes(changed)


def with_riff_length(data: bytes) -> bytes:
    """Return a WebP whose whole length is right."""
    return data[:4] + struct.pack("<I", max(len(data) - 8, 0)) + data[8:]


FORMATS = {
    "jpeg": Format(".jpg", jpegs, read, (FrameError,)),
    "png": Format(".png", pngs, read, (FrameError,), with_png_checksums),
    "webp": Format(".webp", webps, read, (FrameError,), with_riff_length),
    "tiff": Format(".tif", tiffs, read, (FrameError,)),
    "bmp": Format(".bmp", bmps, read, (FrameError,)),
    "pnm": Format(".ppm", pnms, read, (FrameError,)),
    "gif": Format(".gif", gifs, read, (FrameError,)),
    "foreign": Format(".jpg", foreign, read, (FrameError,)),
}
if can_read_heic():
    FORMATS["heic"] = Format(".heic", heics, read, (FrameError,))
