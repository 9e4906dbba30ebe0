"""The parts of any file that has many frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slamcli.core.config import FrameSelection
from slamcli.io.containers.bag import BAG_SUFFIXES, is_bag
from slamcli.io.containers.bag_frames import bag_frames
from slamcli.io.containers.part import Part, Progress
from slamcli.io.containers.video import VIDEO_SUFFIXES, video_frames

CONTAINER_SUFFIXES = VIDEO_SUFFIXES | BAG_SUFFIXES


def is_container(path: Path) -> bool:
    """Return whether a path is a video or a bag."""
    return is_bag(path) or (path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir())


def parts_of(path: Path, selection: FrameSelection, progress: Progress) -> Sequence[Part] | None:
    """Return the chosen frames of a video or a bag; None for any other file or folder.

    Raises
    ------
    InputError
    """
    if is_bag(path):
        return bag_frames(path, selection, progress)
    return video_frames(path, selection, progress) if is_container(path) else None
