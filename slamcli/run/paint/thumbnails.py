"""Thumbnails of decoded frames, kept for the exposure comparison."""

from __future__ import annotations

from threading import Lock

from slamcli.core.arrays import UInt8Array
from slamcli.core.records import Frame
from slamcli.io.frames import FrameFile, read_frame
from slamcli.stages import view
from slamcli.stages.mosaic import exposure

_MAX_BYTES = 40_000_000


class Thumbnails:
    """Thumbnails of the first frames, up to a limit in bytes; may be shared by threads.

    They spare decoding a frame a second time. In another process it is empty.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._kept: dict[int, UInt8Array] = {}
        self._bytes = 0

    def __reduce__(self) -> tuple[type[Thumbnails], tuple[()]]:
        return Thumbnails, ()

    def keep(self, frame: Frame) -> None:
        """Add a frame's thumbnail, while there is room."""
        if self._bytes < _MAX_BYTES:
            small = thumbnail(frame)
            with self._lock:
                self._kept[frame.index] = small
                self._bytes += small.nbytes

    def take(self, file: FrameFile) -> UInt8Array | None:
        """Remove and return a frame's thumbnail; None when it was not kept."""
        with self._lock:
            small = self._kept.pop(file.index, None)
            self._bytes -= 0 if small is None else small.nbytes
        return small


def thumbnail(frame: Frame) -> UInt8Array:
    """Return a frame as `exposure.observe` takes it: gray, (h, w), reduced."""
    return exposure.thumbnail(view.to_gray(frame.image))


def read_thumbnail(file: FrameFile) -> UInt8Array:
    """Return the thumbnail of a frame that was not kept; raises FrameError."""
    return thumbnail(read_frame(file, gray=True))
