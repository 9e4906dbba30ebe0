"""A part: one picture of a file that has several, such as a video, a bag or a TIFF of many pages.

Parts go where frame files go: to threads, and pickled to other processes, which open the file anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Protocol

import numpy as np

from slamcli.core.arrays import UInt8Array

_DIGEST_BYTES = 16

Progress = Callable[[str, int, int], None]


def silent(_stage: str, _done: int, _total: int) -> None:
    """Show no progress."""


def digest_of(content: bytes | UInt8Array) -> bytes:
    """Return the digest of an encoded picture, or of pixels."""
    data = content if isinstance(content, bytes) else np.ascontiguousarray(content).data
    return hashlib.blake2b(data, digest_size=_DIGEST_BYTES).digest()


class Part(Protocol):
    """One picture of a file."""

    @property
    def name(self) -> str:
        """Name of the frame: that of the file which `slam extract` writes."""

    @property
    def stamp(self) -> float | None:
        """Seconds; None where the file has no times."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels, as the picture is to be seen."""

    @property
    def note(self) -> str:
        """What was taken of the file, the same for all of its parts; may be empty."""

    def content(self) -> bytes | UInt8Array:
        """Return an encoded picture, or (H, W) gray or (H, W, 3) BGR pixels.

        Raises
        ------
        FrameError
        """
