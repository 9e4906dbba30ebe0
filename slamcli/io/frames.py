"""Frame files: listed in natural order, decoded to 8-bit BGR, each fault reported in one line."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np

from slamcli.core.arrays import BoolArray, UInt8Array
from slamcli.core.errors import FrameError, InputError
from slamcli.core.records import Frame

IMAGE_SUFFIXES = frozenset(
    {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
)
MIN_SIDE_PIXELS = 16
# A name such as 1446412345.250 is the time of capture in seconds since 1970 (TUM's convention).
_EPOCH_NAME = re.compile(r"\d{9,10}\.\d+|\d{10}")


@dataclass(frozen=True, slots=True)
class FrameFile:
    """The file of a frame, not read yet.

    Attributes
    ----------
    index : int
        Number in the sequence, from 0.
    path : Path
    stamp : float or None
        Seconds, from the name or the frame rate.
    """

    index: int
    path: Path
    stamp: float | None

    @property
    def name(self) -> str:
        """The file's name without its folder."""
        return self.path.name


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key under which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", name.casefold())
    key = tuple(
        (1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts if part
    )
    return (*key, (0, 0, name))


def list_frames(sources: Sequence[Path], frame_rate: float | None = None) -> list[FrameFile]:
    """Return the pictures of folders and files, naturally sorted within each folder.

    A folder without pictures of its own stands for its ``frames`` folder.

    Parameters
    ----------
    sources : folders or picture files
    frame_rate : float or None
        Frames per second, to give stamps to frames whose names carry none.

    Raises
    ------
    InputError
        When a source does not exist, or there is no picture at all.
    """
    paths: list[Path] = []
    for source in sources:
        if source.is_dir():
            paths += _pictures_in(source)
        elif source.exists():
            paths.append(source)
        else:
            raise InputError(f"{source} does not exist; give a folder of frames or image files")
    if not paths:
        suffixes = " ".join(sorted(IMAGE_SUFFIXES))
        raise InputError(f"no images in {', '.join(map(str, sources))}; looked for {suffixes}")
    return [
        FrameFile(index, path, _stamp(path, index, frame_rate)) for index, path in enumerate(paths)
    ]


def read_frame(file: FrameFile, *, gray: bool = False, halved: bool = False) -> Frame:
    """Return the decoded frame; raises FrameError.

    Parameters
    ----------
    gray : bool
        As (H, W), more quickly.
    halved : bool
        In colours, of half the size, more quickly: each pixel the mean of two by two. The mask
        stays whole.
    """
    kind = cv2.IMREAD_REDUCED_COLOR_2 if halved else cv2.IMREAD_COLOR_BGR
    image, mask = _decode(file.path, cv2.IMREAD_GRAYSCALE if gray else kind)
    return Frame(file.index, file.name, file.stamp, image, mask)


def read_reduced_gray(file: FrameFile) -> UInt8Array:
    """Return the frame as (h, w) gray of a quarter of its size, quickly; raises FrameError."""
    try:
        data = np.frombuffer(file.path.read_bytes(), np.uint8)
        small = cv2.imdecode(data, cv2.IMREAD_REDUCED_GRAYSCALE_4) if data.size else None
    except OSError as error:
        raise FrameError(f"cannot be read: {error.strerror or error}") from error
    except cv2.error as error:
        raise FrameError("too many pixels to be decoded; save it smaller") from error
    if small is None:
        small = cv2.cvtColor(read_image(file.path), cv2.COLOR_BGR2GRAY)[::4, ::4]
    return np.asarray(small, dtype=np.uint8)


def read_image(path: Path) -> UInt8Array:
    """Return a picture as (H, W, 3) uint8 BGR, turned as its EXIF orientation says.

    16-bit samples are cut to their upper 8 bits, gray is repeated, CMYK converted, and
    transparency dropped.

    Raises
    ------
    FrameError
        When the file is missing, empty, truncated, too small or no picture.
    """
    return _decode(path)[0]


def _pictures_in(folder: Path) -> list[Path]:
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise InputError(f"cannot list {folder}: {error.strerror or error}") from error
    inner = folder / "frames"
    if inner.is_dir() and inner in entries:
        return _pictures_in(inner)
    pictures = [
        path
        for path in entries
        if path.suffix.lower() in IMAGE_SUFFIXES
        and not path.name.startswith(".")
        and not path.is_dir()
    ]
    return sorted(pictures, key=lambda path: natural_key(path.name))


def _stamp(path: Path, index: int, frame_rate: float | None) -> float | None:
    if _EPOCH_NAME.fullmatch(path.stem):
        return float(path.stem)
    return None if frame_rate is None else index / frame_rate


def _decode(path: Path, kind: int = cv2.IMREAD_COLOR_BGR) -> tuple[UInt8Array, UInt8Array | None]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(f"cannot be read: {error.strerror or error}") from error
    if not data:
        raise FrameError("the file is empty (0 bytes)")
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), kind)
    except cv2.error as error:
        raise FrameError("too many pixels to be decoded; save it smaller") from error
    whole = decoded is not None and _ends_whole(data)
    factor = 2 if kind == cv2.IMREAD_REDUCED_COLOR_2 else 1
    image = np.asarray(decoded) if whole else _decode_strictly(data, factor)
    height, width = factor * image.shape[0], factor * image.shape[1]
    if min(height, width) < MIN_SIDE_PIXELS:
        raise FrameError(f"{width}x{height} pixels is too small to show a floor")
    return np.asarray(image, dtype=np.uint8), _transparency(data)


def _ends_whole(data: bytes) -> bool:
    """Return whether a JPEG or PNG has its end marker; OpenCV decodes a truncated one silently."""
    if data.startswith(b"\xff\xd8"):
        return data.rstrip(b"\0").endswith(b"\xff\xd9")
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-64:]
    return True


def _decode_strictly(data: bytes, factor: int) -> UInt8Array:
    """Decode by Pillow, which refuses a truncated file, and shrink by `factor`.

    Raises
    ------
    FrameError
    """
    try:
        image = imageio.imread(io.BytesIO(data), index=0, plugin="pillow", mode="RGB", rotate=True)
    except (OSError, SyntaxError, ValueError) as error:
        if _ends_whole(data):
            fault = "not an image, or of a kind that cannot be read; save it as PNG or JPEG"
        else:
            fault = "truncated: the end of the file is missing"
        raise FrameError(fault) from error
    small = cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(np.asarray(small, np.uint8)[..., ::-1])


def _transparency(data: bytes) -> UInt8Array | None:
    """Return the alpha channel of a PNG that has one which hides something."""
    # Byte 25 of a PNG is its colour type; 4 and 6 carry alpha. No other needs a second decode.
    if not data.startswith(b"\x89PNG") or len(data) < 26 or data[25] not in {4, 6}:
        return None
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded is None or decoded.ndim != 3 or decoded.shape[2] != 4:
        return None
    alpha = np.asarray(decoded)[..., 3]
    opaque: BoolArray = np.asarray(alpha == (65535 if alpha.dtype == np.uint16 else 255))
    return None if opaque.all() else np.where(opaque, np.uint8(255), np.uint8(0))
