"""What lies beside the frames, or in their files, and is not read: counted, for the user."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from slamcli.io.frames import IMAGE_SUFFIXES
from slamcli.io.images import tiff
from slamcli.io.images.plain import count_gif_frames

# Files that a folder of frames may have for another purpose: readings, settings, results.
_COMPANIONS = frozenset({".csv", ".json", ".md", ".slam", ".toml", ".txt", ".yaml", ".yml"})
_NAMES = {
    **dict.fromkeys((".heic", ".heif"), "HEIC"),
    **dict.fromkeys((".avif",), "AVIF"),
    **dict.fromkeys((".gif",), "GIF"),
    **dict.fromkeys((".jp2", ".j2k"), "JPEG 2000"),
    **dict.fromkeys((".jxl",), "JPEG XL"),
    **dict.fromkeys((".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2"), "raw"),
    **dict.fromkeys((".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"), "video"),
}
_OTHER = "other"


def unread_note(paths: Sequence[Path]) -> str:
    """Return what is not read of the folders of the frames and of their files; empty for nothing.

    Parameters
    ----------
    paths : the frames' files
    """
    frames = set(paths)
    kinds: Counter[str] = Counter()
    for folder in {path.parent for path in paths}:
        # A frame that was named alone says nothing of the rest of its folder.
        beside = _files_in(folder)
        if frames.issuperset(path for path in beside if path.suffix.lower() in IMAGE_SUFFIXES):
            kinds.update(_NAMES.get(path.suffix.lower(), _OTHER) for path in beside - frames)
    notes = [f"{count} {kind} file{'s' * (count > 1)}" for kind, count in sorted(kinds.items())]
    pages = sum(_further_pictures(path, {".tif", ".tiff"}) for path in paths)
    images = sum(_further_pictures(path, {".gif"}) for path in paths)
    notes += [f"{pages} further pages of TIFF files"] * bool(pages)
    notes += [f"{images} further frames of GIF files"] * bool(images)
    return f"not read: {', '.join(notes)}" if notes else ""


def _files_in(folder: Path) -> set[Path]:
    try:
        return {
            path
            for path in folder.iterdir()
            if not path.name.startswith(".")
            and path.suffix.lower() not in _COMPANIONS
            and path.is_file()
        }
    except OSError:  # a file may be readable in a folder that cannot be listed
        return set()


def _further_pictures(path: Path, suffixes: set[str]) -> int:
    if path.suffix.lower() not in suffixes or not path.is_file():
        return 0
    try:
        with path.open("rb") as stream:
            pictures = count_gif_frames(stream) if ".gif" in suffixes else tiff.count_pages(stream)
    except OSError:  # the frame's own reason says so
        return 0
    return max(pictures - 1, 0)
