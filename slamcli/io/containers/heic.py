"""HEIC photos, as phones take them, read by pillow-heif.

pillow-heif is imported here and nowhere else, and only for such a file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import FrameError, InputError
from slamcli.io.images.decoding import read_bytes
from slamcli.io.images.header import Header

HEIC_SUFFIXES = frozenset({".heic", ".heif"})


@dataclass(frozen=True, slots=True)
class HeicPicture:
    """A HEIC photo, not decoded yet: a `Part`, the only one of its file.

    Attributes
    ----------
    path : Path
    size : (int, int)
        Width and height, turned.
    """

    path: Path
    size: tuple[int, int]

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    @property
    def stamp(self) -> None:
        """It is that of the name or of the photo's own clock."""

    @property
    def note(self) -> str:
        """Nothing is left out."""
        return ""

    def content(self) -> UInt8Array:
        """Return (H, W) gray or (H, W, 3) BGR pixels, turned; raises FrameError."""
        with _damage():
            samples = np.asarray(_opened(self.path))
        if samples.ndim == 2:
            return np.asarray(samples, np.uint8)
        return np.asarray(cv2.cvtColor(samples[..., :3], cv2.COLOR_RGB2BGR), np.uint8)


def can_read_heic() -> bool:
    """Return whether pillow-heif is installed."""
    return find_spec("pillow_heif") is not None


def heic_picture(path: Path) -> HeicPicture:
    """Return a HEIC photo.

    Raises
    ------
    InputError
        When pillow-heif is not installed, or the file is no HEIC photo.
    """
    if not can_read_heic():
        raise InputError(f"the photo {path} needs pillow-heif: pip install 'slamcli[heic]'")
    try:
        size = _opened(path).size
    except FrameError:  # it becomes the frame's reason when it is read
        size = (0, 0)
    return HeicPicture(path.absolute(), size)


def heic_exif(path: Path) -> bytes:
    """Return the EXIF block of a HEIC photo; empty without one. Raises FrameError."""
    with _damage():
        return bytes(_opened(path).info.get("exif") or b"")


def _opened(path: Path) -> Any:
    """Return the photo, whose size is within the limits of all pictures; raises FrameError."""
    import pillow_heif

    data = read_bytes(path)
    with _damage():
        picture = pillow_heif.open_heif(data, convert_hdr_to_8bit=True)
        # A file may have no picture at all: its size raises.
        Header(*picture.size)
    return picture


@contextmanager
def _damage() -> Iterator[None]:
    """Raise FrameError for whatever the decoder raises."""
    try:
        yield
    except FrameError:
        raise
    except Exception as error:
        raise FrameError(f"damaged: {' '.join(str(error).split())}") from error
