"""Picture files as frames: pages of a file, and stamps by the names or by the camera's clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamcli.core.errors import FrameError
from slamcli.io.containers.heic import HEIC_SUFFIXES, can_read_heic, heic_exif, heic_picture
from slamcli.io.containers.pages import file_pages
from slamcli.io.containers.part import Part
from slamcli.io.images.photo import PhotoInfo, photo_info, photo_stamps, read_photo_info
from slamcli.io.stamps import stamps_of_names

_PAGED_SUFFIXES = frozenset({".gif", ".tif", ".tiff"})


@dataclass(frozen=True, slots=True)
class Listed:
    """A picture that was found: its file, which part of it, and its own stamp."""

    path: Path
    part: Part | None = None
    stamp: float | None = None


def listed(path: Path) -> list[Listed]:
    """Return the frames of a picture file: one, or its pages."""
    if path.suffix.lower() in HEIC_SUFFIXES:
        return [Listed(path, heic_picture(path))]
    pages = file_pages(path) if path.suffix.lower() in _PAGED_SUFFIXES else []
    return [Listed(path, page) for page in pages] or [Listed(path)]


def stamped(pictures: Sequence[Listed], frame_rate: float | None, *, ordered: bool) -> list[Listed]:
    """Return pictures with the stamps of their names, in whose order they are unless it is given.

    Without any, those of the camera's own clock. A frame rate takes the place of stamps that may be
    something else.
    """
    stamps = stamps_of_names([one.path.stem for one in pictures])
    if stamps is not None and (frame_rate is None or stamps.sure):
        found = [replace(one, stamp=s) for one, s in zip(pictures, stamps.seconds, strict=True)]
        return found if ordered else sorted(found, key=lambda one: one.stamp or 0.0)
    taken = _photo_stamps([one.path for one in pictures]) if frame_rate is None else None
    if taken is None:
        return list(pictures)
    return [replace(one, stamp=stamp) for one, stamp in zip(pictures, taken, strict=True)]


def _photo_stamps(paths: Sequence[Path]) -> list[float] | None:
    """Return the times that cameras noted, when they are those of the pictures' order."""
    infos = []
    for path in paths:
        info = photo_info_of(path)
        if info.seconds is None:
            return None
        infos.append(info)
    return photo_stamps(infos)


def photo_info_of(path: Path) -> PhotoInfo:
    """Return what a camera noted in a picture; nothing where it cannot be read."""
    try:
        if path.suffix.lower() in HEIC_SUFFIXES:
            return photo_info(heic_exif(path)) if can_read_heic() else PhotoInfo()
        return read_photo_info(path)
    except FrameError:  # it becomes the frame's reason when it is read
        return PhotoInfo()
