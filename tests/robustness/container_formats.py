"""Videos and bags for the fuzzer: small good files of each, and what reading one promises."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from bag_files import BagWriter, write_bag
from fuzz import Format, SilentlyWrongError
from picture_formats import picture
from video_files import write_video

from slamcli.core.config import FrameSelection
from slamcli.core.errors import FrameError, InputError
from slamcli.io.containers.bag_readings import (
    antenna_metres,
    camera_info,
    read_bag_compass,
    read_bag_gps,
    read_bag_odometry,
)
from slamcli.io.frames import list_frames, read_frame

_REASONS = (InputError, FrameError)
# Of each file, so many frames are read.
_MAX_READ = 6


def pictures() -> list[np.ndarray]:
    """Return pictures that differ."""
    return [np.roll(picture(), 5 * shift, axis=1) for shift in range(4)]


def video(suffix: str, codec: str, pixels: str) -> bytes:
    """Return a video of these pictures."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_video(Path(folder) / f"v{suffix}", pictures(), codec=codec, pixels=pixels)
        return path.read_bytes()


def readings(bag: BagWriter) -> None:
    """Add a reading of each kind."""
    for number in range(3):
        bag.odometry("/odom", 0.1 * number, 0.02 * number, 0.0, 0.1)
        bag.fix(0.1 * number, 29.6, -82.3)
        bag.imu(0.1 * number, 0.5)
    bag.lens("/camera/camera_info", (60, 46), 50.0)
    bag.transform("base_link", "gps", 0.1, 0.2, 0.0)


def bag(name: str, encoding: str) -> bytes:
    """Return the file of a bag of these pictures, with readings."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_bag(Path(folder) / name, pictures(), readings, encoding=encoding)
        if path.is_dir():
            (path,) = [one for one in path.iterdir() if one.suffix != ".yaml"]
        return path.read_bytes()


def read_frames(path: Path) -> None:
    """Read the frames of a file with many."""
    files = list_frames([path], selection=FrameSelection(frames_per_second=1000.0))
    for file in files[:_MAX_READ]:
        frame = read_frame(file)
        if frame.image.dtype != np.uint8 or frame.image.ndim != 3:
            raise SilentlyWrongError("no BGR of 8 bits")
        if frame.stamp is not None and not np.isfinite(frame.stamp):
            raise SilentlyWrongError("a stamp that is not finite")


def read_bag(path: Path) -> None:
    """Read the frames and all readings of a bag."""
    faults = []
    ways: Sequence[Callable[[Path], object]] = (
        *(read_frames, read_bag_odometry, read_bag_gps, read_bag_compass, antenna_metres),
        partial(camera_info, beside=""),
    )
    for way in ways:
        try:
            way(path)
        except _REASONS as error:
            faults.append(error)
    if faults:
        raise faults[0]


def files(make: Callable[..., bytes], *each: tuple[str, ...]) -> Callable[[], Sequence[bytes]]:
    return lambda: [make(*arguments) for arguments in each]


FORMATS = {
    "mkv": Format(".mkv", files(video, (".mkv", "ffv1", "bgr0")), read_frames, _REASONS),
    "mp4": Format(
        ".mp4",
        files(video, (".mp4", "mpeg4", "yuv420p"), (".mp4", "libx264", "yuv420p")),
        read_frames,
        _REASONS,
    ),
    "avi": Format(".avi", files(video, (".avi", "mjpeg", "yuvj420p")), read_frames, _REASONS),
    "bag": Format(".bag", files(bag, ("b.bag", "bgr8"), ("b.bag", "png")), read_bag, _REASONS),
    "mcap": Format(".mcap", files(bag, ("b_mcap", "bgr8"), ("b_mcap", "png")), read_bag, _REASONS),
    "db3": Format(".db3", files(bag, ("b", "bgr8"), ("b", "png")), read_bag, _REASONS),
}
