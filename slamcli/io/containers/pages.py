"""TIFF and GIF files of several pages, each a frame, read by imageio.

imageio is imported here and nowhere else, and only for such a file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import FrameError
from slamcli.io.images import plain, tiff
from slamcli.io.images.decoding import CAMERA_BITS, MAX_FILE_BYTES
from slamcli.io.images.exif import turn
from slamcli.io.images.header import Header

_GIF = b"GIF8"


@dataclass(frozen=True, slots=True)
class Page:
    """One page of a file, not decoded yet: a `Part`.

    Attributes
    ----------
    pages : Pages
    number : int
        From 0.
    name : str
        That of the file with the page's number, from 1.
    size : (int, int)
        Width and height, as they are to be seen.
    note : str
        How many pages are read.
    """

    pages: Pages
    number: int
    name: str
    size: tuple[int, int]
    note: str

    @property
    def stamp(self) -> None:
        """Pages have no times."""

    def content(self) -> UInt8Array:
        """Return (H, W) gray or (H, W, 3) BGR pixels; raises FrameError."""
        return self.pages.page(self.number)


def can_read_pages() -> bool:
    """Return whether imageio is installed."""
    return find_spec("imageio") is not None


def file_pages(path: Path) -> list[Page]:
    """Return the pages of a TIFF or GIF that has several; none of any other file.

    Pages of another size than the first are reduced copies of it, as maps have them. Without
    imageio a file is its first page.
    """
    count = _count(path)
    if count < 2 or not can_read_pages():
        return []
    pages = Pages(path)
    try:
        first = pages.size(0)
        same = [number for number in range(count) if pages.size(number) == first]
    except FrameError:  # the decoder of single pictures says what is wrong with it
        return []
    if len(same) < 2:
        return []
    digits = len(str(count))
    note = f"{path.name}: {len(same)} of {count} pages taken"
    return [
        Page(pages, number, f"{path.stem}_{number + 1:0{digits}d}{path.suffix}", first, note)
        for number in same
    ]


def _count(path: Path) -> int:
    """Return how many pages a TIFF or GIF has; 0 for any other file."""
    try:
        if not path.is_file() or path.stat().st_size > MAX_FILE_BYTES:
            return 0
        with path.open("rb") as stream:
            head = stream.read(4)
            stream.seek(0)
            if head.startswith(tiff.SIGNATURES):
                return tiff.count_pages(stream)
            return plain.count_frames(stream) if head == _GIF else 0
    except OSError:
        return 0


class Pages:
    """An open file of pages; may be shared by threads. In another process it is opened anew.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        # Workers of a cluster run in folders of their own.
        self._path = path.absolute()
        self._lock = Lock()

    def __reduce__(self) -> tuple[object, ...]:
        return Pages, (self._path,)

    def size(self, number: int) -> tuple[int, int]:
        """Return a page's width and height, as they are to be seen; raises FrameError."""
        with self._lock:
            return self._header(number).size

    def page(self, number: int) -> UInt8Array:
        """Return a page's pixels, turned: (H, W) gray or (H, W, 3) BGR; raises FrameError."""
        with self._lock:
            header = self._header(number)
            try:
                samples = np.asarray(self._file.read(index=number))
                bits = self._bits if samples.dtype.itemsize > 1 else 8
            except Exception as error:
                raise _unread(error) from error
        if samples.shape[:2] != (header.height, header.width):
            raise FrameError("damaged: a page has other pixels than its header declares")
        return turn(_pixels(samples, bits), header.orientation)

    def _header(self, number: int) -> Header:
        """Return what a page declares, within the limits of all pictures; raises FrameError."""
        try:
            found = self._file.properties(index=number)
        except Exception as error:
            raise _unread(error) from error
        height, width = found.shape[:2]
        return Header(width, height, 8 * found.dtype.itemsize, self._orientation)

    @cached_property
    def _file(self) -> Any:
        import imageio.v3

        return imageio.v3.imopen(self._path, "r", plugin="pillow")

    @cached_property
    def _orientation(self) -> int:
        """EXIF code of the first page; 1 for a GIF."""
        data = self._path.read_bytes()
        return tiff.read_header(data).orientation if data.startswith(tiff.SIGNATURES) else 1

    @cached_property
    def _bits(self) -> int:
        """The range of samples of 16 bits, by some pages: 12 bits in 16 are to be no black."""
        count = _count(self._path)
        some = {0, count // 2, count - 1}
        largest = max(int(np.max(self._file.read(index=number))) for number in some)
        return next((depth for depth in CAMERA_BITS if largest < 1 << depth), CAMERA_BITS[-1])


def _pixels(samples: Any, bits: int) -> UInt8Array:
    """Return samples as 8 bits, gray or BGR; raises FrameError."""
    if samples.dtype == np.bool_:
        samples = samples.astype(np.uint8) * 255
    elif samples.dtype.kind in "ui" and bits > 8:
        samples = np.minimum(samples >> (bits - 8), 255).astype(np.uint8)
    if samples.dtype != np.uint8 or samples.ndim not in {2, 3}:
        raise FrameError(f"a page with samples of {samples.dtype} cannot be read; save it as PNG")
    if samples.ndim == 2:
        return np.asarray(samples, np.uint8)
    channels = samples.shape[2]
    if channels == 2:
        return np.ascontiguousarray(samples[..., 0])
    return np.asarray(cv2.cvtColor(samples[..., :3], cv2.COLOR_RGB2BGR), np.uint8)


def _unread(error: Exception) -> FrameError:
    if isinstance(error, FrameError):
        return error
    return FrameError(f"the decoder refuses it: {' '.join(str(error).split()) or 'no reason'}")
