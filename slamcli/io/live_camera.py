"""A live camera: a device or a stream, of which the newest picture is always at hand."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Condition, Thread
from typing import Self

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import InputError

_OPEN_MILLISECONDS, _READ_MILLISECONDS = 10_000, 10_000
# How long to wait for a picture before looking whether to stop.
_WAIT_SECONDS = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One picture of a live camera.

    Attributes
    ----------
    stamp : float
        When it arrived, seconds since 1970.
    image : (H, W, 3) uint8 BGR
    """

    stamp: float
    image: UInt8Array


class LiveCamera:
    """A camera that is read by a thread of its own, as fast as it gives pictures.

    A reader that takes longer than one picture gets the newest; those between are skipped, so that
    poses do not lag behind the robot. A context manager.

    Parameters
    ----------
    source : str
        The number of a camera, a device such as ``/dev/video0``, or the address of an RTSP or HTTP
        stream.

    Attributes
    ----------
    taken, skipped : int
        Pictures that the reader got, and that came while it was busy.

    Raises
    ------
    InputError
        When there is no such camera or stream, or it gives no picture.
    """

    def __init__(self, source: str) -> None:
        self._capture = _open(source)
        there, image = self._capture.read()
        if not there:
            self._capture.release()
            raise InputError(
                f"{source} is open and gives no picture; does its own viewer show one?"
            )
        self.taken = self.skipped = 0
        self._newest, self._is_new, self._ended = Shot(time.time(), _bgr(image)), True, False
        self._changed = Condition()
        self._closing = False
        self._thread = Thread(target=self._read, daemon=True)
        self._thread.start()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its pictures, pixels."""
        height, width = self._newest.image.shape[:2]
        return width, height

    @property
    def newest(self) -> Shot:
        """The newest picture, also when it was taken before."""
        return self._newest

    def shots(self, stops: Callable[[], bool]) -> Iterator[Shot]:
        """Yield the newest picture each time, until the stream ends or `stops` returns True."""
        while not stops():
            with self._changed:
                self._changed.wait_for(lambda: self._is_new or self._ended, _WAIT_SECONDS)
                if not self._is_new:
                    if self._ended:
                        return
                    continue
                self._is_new = False
                self.taken += 1
                shot = self._newest
            yield shot

    def _read(self) -> None:
        """Read pictures until the stream ends, or the camera is closed."""
        while not self._closing:
            there, image = self._capture.read()
            with self._changed:
                if there:
                    self.skipped += self._is_new
                    self._newest, self._is_new = Shot(time.time(), _bgr(image)), True
                self._ended = not there
                self._changed.notify_all()
            if not there:
                break
        self._capture.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join(timeout=_READ_MILLISECONDS / 1000)


def _open(source: str) -> cv2.VideoCapture:
    """Return an open capture; raises InputError."""
    if source.isdecimal() and len(source) < 4:
        capture = cv2.VideoCapture(int(source))
        remedy = "is it connected, free, and readable by you? Numbers begin with 0"
    elif "://" in source:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _OPEN_MILLISECONDS]
        limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, _READ_MILLISECONDS]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        remedy = "does it run, and is the address complete, with its port and path?"
    elif Path(source).is_char_device():
        capture = cv2.VideoCapture(source)
        remedy = "is it a camera, free, and readable by you?"
    else:
        if Path(source).exists():
            raise InputError(f"{source} is no live camera; slam stitch takes files and folders")
        raise InputError(
            f"{source} is no live camera; give its number, a device such as /dev/video0, or the "
            "address of a stream such as http://127.0.0.1:8080/video.mjpg"
        )
    if not capture.isOpened():
        capture.release()
        raise InputError(f"cannot open the camera {source}; {remedy}")
    return capture


def _bgr(image: object) -> UInt8Array:
    """Return a picture as (H, W, 3) BGR."""
    pixels = np.asarray(image, np.uint8)
    return pixels if pixels.ndim == 3 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR))
