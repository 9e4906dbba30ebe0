"""Video files, read by PyAV: frames by their presentation stamps, turned as the metadata say.

PyAV is imported here and nowhere else, and only for a video. imageio's own plugin for it has no
presentation stamps as integers and seeks by an assumed constant rate.
"""

from __future__ import annotations

import stat
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import FrameSelection
from slamcli.core.errors import FrameError, InputError, SlamcliError
from slamcli.core.failures import logged
from slamcli.io.containers.choice import Candidate, Counts, choose
from slamcli.io.containers.part import Progress, digest_of, silent
from slamcli.io.images.exif import turn
from slamcli.io.images.header import Header

# The demuxer is chosen by the suffix: left to itself, FFmpeg would also open playlists, which name
# other files and addresses.
_FORMATS = {
    **dict.fromkeys((".mp4", ".m4v", ".mov", ".3gp"), "mov"),
    **dict.fromkeys((".mkv", ".webm"), "matroska"),
    **dict.fromkeys((".ts", ".mts", ".m2ts"), "mpegts"),
    **dict.fromkeys((".mpg", ".mpeg"), "mpeg"),
    **dict.fromkeys((".wmv",), "asf"),
    **dict.fromkeys((".ogv",), "ogg"),
    **dict.fromkeys((".avi",), "avi"),
    **dict.fromkeys((".flv",), "flv"),
}
VIDEO_SUFFIXES = frozenset(_FORMATS)
# Of damage in these the decoder says nothing unless it is made to refuse the frame; in others it
# flags the frame.
_INTRA_ONLY = frozenset({"mjpeg"})
# Decoded pictures that wait for the next reader.
_MAX_KEPT_BYTES = 256 * 2**20
_MAX_FRAMES = 1_000_000
# What is nearer than this is decoded on the way rather than sought.
_SEEK_SECONDS = 1.0
# A seek may land behind the frames that a picture needs: then from so much before, then from the
# beginning.
_MARGINS_SECONDS = (0.0, 2.0, 10.0)
# The signs of a display matrix, and the EXIF code of the same turn.
_TURNS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """A frame of a video, not decoded yet: a `Part`.

    Attributes
    ----------
    video : Video
    presentation : int
        Its stamp in the video's own units.
    name : str
        Its stamp and ``.png``.
    stamp : float
        Seconds from the video's first frame, rounded as in the name.
    size : (int, int)
        Width and height, turned.
    note : str
        How many frames were chosen of how many.
    """

    video: Video
    presentation: int
    name: str
    stamp: float
    size: tuple[int, int]
    note: str = ""

    def content(self) -> UInt8Array:
        """Return (H, W) gray or (H, W, 3) BGR pixels; raises FrameError."""
        return self.video.frame(self.presentation)


def video_frames(
    path: Path, selection: FrameSelection, progress: Progress = silent
) -> list[VideoFrame]:
    """Return the chosen frames of a video, in the order of their stamps.

    Raises
    ------
    InputError
        When PyAV is not installed, or the file is no video, or has no frame in that part.
    """
    taken: list[tuple[int, float, tuple[int, int]]] = []
    counts, keyframes, digests = Counts(), list[int](), dict[int, bytes]()
    with _refused(path), _Reader(path) as reader:
        candidates = _candidates(reader, keyframes, progress)
        for one in choose(candidates, selection, reader.step_seconds, counts):
            pixels, shown = reader.pixels(one.payload), one.payload.pts
            digests[shown] = digest_of(pixels)
            taken.append((shown, round(one.seconds, 6), (pixels.shape[1], pixels.shape[0])))
            if len(taken) == _MAX_FRAMES:
                break
        counts.damaged = reader.damaged
        counts.all += reader.damaged
    if not taken:
        raise InputError(f"{path} has no frame that can be read in the part that was chosen")
    # Without any, decoding begins with the first frame.
    video = Video(path, tuple(keyframes) or (taken[0][0],), digests)
    note = counts.note(path.name, len(taken))
    return [
        VideoFrame(video, shown, f"{seconds:.6f}.png", seconds, size, note)
        for shown, seconds, size in taken
    ]


def _candidates(
    reader: _Reader, keyframes: list[int], progress: Progress
) -> Iterator[Candidate[Any]]:
    """Yield the sound frames; note where decoding can begin."""
    shown = 0
    for frame in reader.frames():
        if frame.key_frame:
            keyframes.append(frame.pts)
        seconds = float((frame.pts - reader.first) * reader.time_base)
        if shown < int(seconds) <= reader.seconds:
            shown = int(seconds)
            progress("reading video", shown, reader.seconds)
        yield Candidate(seconds, reader.gray(frame), frame)


class Video:
    """Random access to the chosen frames of a video, the last decoded of them in memory.

    May be shared by threads. In another process it starts without an open file.

    Parameters
    ----------
    path : Path
    keyframes : tuple of int
        Stamps at which decoding can begin, increasing.
    digests : dict of int to bytes
        Of the pixels of the chosen frames by their stamps, when the video was searched from its
        beginning: a seek that ends elsewhere, or a file that has changed, is noticed.
    """

    def __init__(self, path: Path, keyframes: tuple[int, ...], digests: dict[int, bytes]) -> None:
        # Workers of a cluster run in folders of their own.
        self._path = path.absolute()
        self._keyframes = keyframes
        self._digests = digests
        self._lock = Lock()
        self._reader: _Reader | None = None
        self._coming: Iterator[Any] = iter(())
        self._at: int | None = None
        self._margin = 0
        self._kept: OrderedDict[int, UInt8Array] = OrderedDict()

    def __reduce__(self) -> tuple[object, ...]:
        return Video, (self._path, self._keyframes, self._digests)

    def frame(self, presentation: int) -> UInt8Array:
        """Return a chosen frame's pixels, turned: (H, W) or (H, W, 3) uint8; raises FrameError."""
        with self._lock:
            try:
                with _refused(self._path):
                    while presentation not in self._kept:
                        self._go_to(presentation)
                        self._decode_to(presentation)
            except InputError as error:
                raise FrameError(f"cannot be read: {error}") from error
            self._kept.move_to_end(presentation)
            return self._kept[presentation]

    def _go_to(self, presentation: int) -> None:
        """Open the file, and seek where the frame is not among the next ones."""
        if self._reader is None:
            self._reader = _Reader(self._path)
        place = bisect_right(self._keyframes, presentation) - 1
        keyframe = self._keyframes[max(place, 0)]
        far = _SEEK_SECONDS / self._reader.time_base
        if self._at is not None and self._at < presentation and keyframe <= self._at + far:
            return
        if self._margin < len(_MARGINS_SECONDS):
            margin = _MARGINS_SECONDS[self._margin] / self._reader.time_base
            self._reader.seek(int(keyframe - margin))
        else:
            self._reader = _Reader(self._path)
        self._coming = self._reader.frames()

    def _decode_to(self, presentation: int) -> None:
        """Keep the frame, and the chosen ones before it; raises FrameError."""
        assert self._reader is not None
        for frame in self._coming:
            self._at = frame.pts
            if frame.pts in self._digests:
                self._keep(frame.pts, self._reader.pixels(frame))
            if frame.pts >= presentation:
                break
        if presentation in self._kept:
            return
        self._at = None
        if self._margin == len(_MARGINS_SECONDS):
            raise FrameError("the video has changed since it was read first")
        # The next seeks go as far back as this one has to.
        self._margin += 1

    def _keep(self, presentation: int, pixels: UInt8Array) -> None:
        if digest_of(pixels) != self._digests[presentation]:
            return
        self._kept[presentation] = pixels
        while len(self._kept) > max(2, _MAX_KEPT_BYTES // pixels.nbytes):
            self._kept.popitem(last=False)


class _Reader:
    """An open video file, decoded in the order of presentation.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
    """

    def __init__(self, path: Path) -> None:
        self._av = _pyav(path)
        self._path = path
        self._container = _opened(self._av, path)
        try:
            self._stream = self._container.streams.video[0]
            context = self._stream.codec_context
            if context is None:
                raise FrameError("there is no decoder of its pictures")
            self._size = context.width, context.height
            Header(*self._size)
        except (IndexError, FrameError) as error:
            self._container.close()
            reason = str(error) if isinstance(error, FrameError) else "it has no video stream"
            raise _unread(path, reason) from error
        self._stream.thread_type = "AUTO"
        if context.name in _INTRA_ONLY:
            context.options = {"err_detect": "explode"}
        self.time_base = self._stream.time_base
        self.first: int = 0
        self.damaged = 0

    def __enter__(self) -> _Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._container.close()

    @cached_property
    def step_seconds(self) -> float:
        """Mean time between two frames; 0 where the file does not say."""
        rate = self._stream.average_rate or self._stream.guessed_rate
        return 1.0 / float(rate) if rate else 0.0

    @cached_property
    def seconds(self) -> int:
        """Length in whole seconds, for a display of progress; 0 where the file does not say."""
        if self._stream.duration is not None:
            return int(self._stream.duration * self.time_base)
        return int((self._container.duration or 0) / self._av.time_base)

    def seek(self, presentation: int) -> None:
        """Go to the last place before a stamp where decoding can begin."""
        with suppress(self._av.FFmpegError):
            self._container.seek(presentation, stream=self._stream)

    def frames(self) -> Iterator[Any]:
        """Yield the sound frames; after a damaged one none until a keyframe repairs the picture."""
        last: int | None = None
        broken = False
        for frame in self._decoded():
            broken = (broken and not (frame and frame.key_frame)) or self._is_damaged(frame)
            if broken:
                self.damaged += 1
            elif last is None or frame.pts > last:
                if last is None and not self.first:
                    self.first = frame.pts
                last = frame.pts
                yield frame

    def _decoded(self) -> Iterator[Any]:
        """Yield what the decoder returns, None for a packet that it refuses."""
        packets = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                return
            except self._av.FFmpegError:  # the file ends here
                return
            try:
                yield from packet.decode()
            except self._av.FFmpegError:
                yield None

    def _is_damaged(self, frame: Any) -> bool:
        """Return whether a frame is missing, flagged by the decoder, without time or too large."""
        if frame is None or frame.is_corrupt or frame.pts is None:
            return True
        return (frame.width, frame.height) != self._size

    def gray(self, frame: Any) -> UInt8Array:
        """Return a frame's luma, not turned; raises InputError."""
        return self._converted(frame, "gray")

    def pixels(self, frame: Any) -> UInt8Array:
        """Return a frame's pixels, turned: gray stays gray, all else is BGR; raises InputError."""
        kind = "gray" if frame.format.name.startswith("gray") else "bgr24"
        return turn(self._converted(frame, kind), _exif_code(frame))

    def _converted(self, frame: Any, kind: str) -> UInt8Array:
        try:
            return np.asarray(frame.to_ndarray(format=kind), np.uint8)
        except (OSError, ValueError) as error:
            raise _unread(self._path, f"its pixels are {frame.format.name}") from error


def _exif_code(frame: Any) -> int:
    """Return the EXIF code of the turn in a frame's display matrix; 1 for one of no quarter."""
    item = frame.side_data.get("DISPLAYMATRIX")
    if item is None:
        return 1
    matrix = np.frombuffer(bytes(item), np.int32)
    signs = tuple(np.sign(matrix[[0, 1, 3, 4]]).tolist())
    return _TURNS.get(signs, 1)


def _unread(path: Path, reason: str) -> InputError:
    return InputError(f"cannot read the video {path}: {reason}")


def _opened(av: Any, path: Path) -> Any:
    """Return the container of a regular file; raises InputError."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise _unread(path, "it is not a regular file")
        kind = _FORMATS[path.suffix.lower()]
        # The prefix keeps a name with a colon from being taken for an address.
        name = f"file:{path.absolute()}"
        return av.open(name, format=kind, options={"protocol_whitelist": "file"})
    except (OSError, ValueError, av.FFmpegError) as error:
        raise _unread(path, getattr(error, "strerror", None) or str(error)) from error


@contextmanager
def _refused(path: Path) -> Iterator[None]:
    """Turn whatever the decoders raise on a damaged video into an InputError."""
    try:
        yield
    except SlamcliError:
        raise
    except Exception as error:
        raise _unread(path, logged(error)) from error


def _pyav(path: Path) -> Any:
    """Return the module; raises InputError without it."""
    try:
        import av
    except ImportError as error:
        raise InputError(f"the video {path} needs PyAV: pip install 'slamcli[video]'") from error
    return av
