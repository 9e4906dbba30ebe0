"""Small gray pictures of frames that have been read, which need not be decoded for it again."""

from __future__ import annotations

from threading import Lock

from slamcli.core.arrays import UInt8Array
from slamcli.core.records import Frame
from slamcli.io.frames import FrameFile, read_frame
from slamcli.stages import view
from slamcli.stages.mosaic import exposure

_MAX_BYTES = 40_000_000


class Thumbnails:
    """What frames look like from afar, of as many as fit; may be shared by threads.

    In another process it is empty.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._kept: dict[int, UInt8Array] = {}
        self._bytes = 0

    def __reduce__(self) -> tuple[type[Thumbnails], tuple[()]]:
        return Thumbnails, ()

    def keep(self, frame: Frame) -> None:
        """Remember what a frame looks like, while there is room."""
        if self._bytes < _MAX_BYTES:
            small = glimpse(frame)
            with self._lock:
                self._kept[frame.index] = small
                self._bytes += small.nbytes

    def take(self, file: FrameFile) -> UInt8Array | None:
        """Return what a frame looks like, and forget it; None when it was not kept."""
        with self._lock:
            small = self._kept.pop(file.index, None)
            self._bytes -= 0 if small is None else small.nbytes
        return small


def glimpse(frame: Frame) -> UInt8Array:
    """Return a frame as `exposure.observe` takes it."""
    return exposure.thumbnail(view.to_gray(frame.image))


def read_glimpse(file: FrameFile) -> UInt8Array:
    """Return what `Thumbnails` would have kept of a frame; raises FrameError."""
    return glimpse(read_frame(file, gray=True))
