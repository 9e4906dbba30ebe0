"""Small pictures of frames and of the map, as data URLs, within a limit on the page's size."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from functools import partial

import cv2

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import FrameError
from slamcli.core.records import Frame, PoseEstimate
from slamcli.io.frames import FrameFile, read_frame
from slamcli.run.session.session import Session

# Longer side of a frame's picture, pixels, for up to so many frames; and of how many there are
# pictures, as each is decoded once more [benchmarks/scale.py].
_SIDES = ((150, 320), (10**9, 240))
_MAX_PICTURES = 400
_QUALITY = 72


def data_url(image: UInt8Array, quality: int) -> str:
    """Return a picture as a JPEG in a data URL."""
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def shrunk(image: UInt8Array, side: int) -> UInt8Array:
    """Return a picture whose longer side has at most so many pixels."""
    scale = side / max(image.shape[:2])
    if scale >= 1.0:
        return image
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


class KeptPictures:
    """Pictures of frames that are decoded for the map, so that the page need not decode them again.

    May be shared by threads. In another process it keeps none.
    """

    def __init__(
        self, files: Sequence[FrameFile] = (), estimates: Sequence[PoseEstimate] = ()
    ) -> None:
        chosen = _chosen(files, estimates)
        self._indices, self._side = {file.index for file in chosen}, _side_of(chosen)
        self.urls: dict[int, str] = {}

    def __reduce__(self) -> tuple[type[KeptPictures], tuple[()]]:
        return KeptPictures, ()

    def keep(self, frame: Frame) -> None:
        """Add a frame's picture, if the page shows it; the frame as `read_frame` halves it."""
        if frame.index in self._indices:
            self.urls[frame.index] = data_url(shrunk(frame.image, self._side), _QUALITY)


def frame_pictures(
    files: Sequence[FrameFile],
    estimates: Sequence[PoseEstimate],
    session: Session,
    kept: Mapping[int, str] | None = None,
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Return data URLs by frame index: of all frames, or of many evenly spread ones.

    What cannot be read again has none; the names of those that were read before follow.

    Parameters
    ----------
    files, estimates : sequences
    session : Session
    kept : mapping of int to str, or None
        From `KeptPictures` of the same frames: by index, those that need not be read again.
    """
    chosen, known = _chosen(files, estimates), kept or {}
    left = [file for file in chosen if file.index not in known]
    work = partial(_picture, side=_side_of(chosen))
    stage = session.on_this_machine().stage("reporting", work, left)
    read = dict(zip((file.index for file in left), stage, strict=True))
    urls = {file.index: known.get(file.index) or read[file.index] for file in chosen}
    unread = tuple(
        file.name
        for file in chosen
        if not urls[file.index] and estimates[file.index].status == "tracked"
    )
    return {str(index): url for index, url in urls.items() if url}, unread


def _chosen(files: Sequence[FrameFile], estimates: Sequence[PoseEstimate]) -> list[FrameFile]:
    """Return the frames that get a picture; half of the places are for those without a pose."""
    if len(files) <= _MAX_PICTURES:
        return list(files)
    lost = [file for file in files if estimates[file.index].map_from_robot is None]
    lost = _spread(lost, _MAX_PICTURES // 2)
    indices = {file.index for file in lost}
    others = [file for file in files if file.index not in indices]
    return sorted([*lost, *_spread(others, _MAX_PICTURES - len(lost))], key=lambda file: file.index)


def _side_of(chosen: Sequence[FrameFile]) -> int:
    return next(side for count, side in _SIDES if len(chosen) <= count)


def _spread(files: Sequence[FrameFile], count: int) -> list[FrameFile]:
    step = max(1, math.ceil(len(files) / max(1, count)))
    return list(files[::step])


def _picture(file: FrameFile, side: int) -> str:
    try:
        image = read_frame(file, halved=True).image
    except FrameError:  # lost for that reason, or vanished since
        return ""
    return data_url(shrunk(image, side), _QUALITY)
