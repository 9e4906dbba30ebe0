"""What lies beside the frames, or in their files, and is not read: counted, for the user."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from slamcli.io.containers.listing import is_container
from slamcli.io.containers.pages import can_read_pages
from slamcli.io.frames import IMAGE_SUFFIXES, FrameFile
from slamcli.io.images import plain, png, tiff, webp
from slamcli.io.images.own import is_marked

# Files that a folder of frames may have for another purpose: readings, settings, results.
_COMPANIONS = frozenset(
    {
        *(".csv", ".json", ".md", ".slam", ".toml", ".txt", ".xml", ".yaml", ".yml"),
        *(".jgw", ".pgw", ".tfw"),
    }
)
_HEIC = "HEIC"
_NAMES = {
    **dict.fromkeys((".heic", ".heif"), _HEIC),
    **dict.fromkeys((".avif",), "AVIF"),
    **dict.fromkeys((".gif",), "GIF"),
    **dict.fromkeys((".jp2", ".j2k"), "JPEG 2000"),
    **dict.fromkeys((".jxl",), "JPEG XL"),
    **dict.fromkeys((".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2"), "raw"),
    **dict.fromkeys((".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm"), "video"),
}
_OTHER = "other"
# Those that imageio reads.
_TIFF_PAGE, _GIF_FRAME = "further TIFF page", "further GIF frame"
_MANY = (
    (tiff.SIGNATURES, _TIFF_PAGE, tiff.count_pages),
    ((png.SIGNATURE,), "further PNG frame", png.count_frames),
    ((b"GIF8",), _GIF_FRAME, plain.count_frames),
    ((b"RIFF",), "further WebP frame", webp.count_frames),
)


def unread_note(files: Sequence[FrameFile]) -> str:
    """Return what is not read of the folders of the frames and of their files; empty for nothing.

    Parameters
    ----------
    files : sequence of FrameFile
        Of the frames; of those that are parts only the folder is looked at.
    """
    frames = {file.path for file in files if not file.path.is_dir()}
    paths = [file.path for file in files if file.part is None]
    kinds: Counter[str] = Counter()
    drawings: list[str] = []
    for folder in {path.parent for path in frames if not is_container(path)}:
        beside = _files_in(folder) - frames
        pictures = {path for path in beside if path.suffix.lower() in IMAGE_SUFFIXES}
        own = {path for path in pictures if is_marked(path)}
        # A frame that was named alone says nothing of the rest of its folder.
        if own == pictures:
            drawings += sorted(path.name for path in own)
            kinds.update(_NAMES.get(path.suffix.lower(), _OTHER) for path in beside - own)
    notes = [_count(count, f"{kind} file") for kind, count in sorted(kinds.items())]
    if kinds[_HEIC]:
        notes.append("HEIC needs pip install 'slamcli[heic]'")
    if drawings:
        notes.append(f"{_count(len(drawings), 'picture')} made by slamcli ({drawings[0]})")
    further: Counter[str] = Counter()
    for path in paths:
        further.update(_further_pictures(path))
    notes += [_count(count, kind) for kind, count in sorted(further.items())]
    if not can_read_pages() and further.keys() & {_TIFF_PAGE, _GIF_FRAME}:
        notes.append("pages need pip install 'slamcli[pages]'")
    return f"not read: {', '.join(notes)}" if notes else ""


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count > 1)}"


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


def _further_pictures(path: Path) -> dict[str, int]:
    """Return what a file has after its first picture, and how many."""
    if not path.is_file():
        return {}
    try:
        with path.open("rb") as stream:
            head = stream.read(12)
            stream.seek(0)
            for starts, name, count in _MANY:
                if head.startswith(starts):
                    pictures = count(stream)
                    return {name: pictures - 1} if pictures > 1 else {}
    except OSError:  # the frame's own reason says so
        pass
    return {}
