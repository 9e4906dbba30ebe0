"""Frame files: listed in natural order, decoded to 8-bit BGR, each fault reported in one line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import FrameSelection
from slamcli.core.errors import FrameError, InputError
from slamcli.core.records import Frame
from slamcli.io.containers.heic import HEIC_SUFFIXES, can_read_heic, heic_picture
from slamcli.io.containers.listing import is_container, parts_of
from slamcli.io.containers.part import Part, Progress, digest_of, silent
from slamcli.io.images import canvas
from slamcli.io.images.decoding import (
    Reading,
    decode,
    from_pixels,
    picture_size,
    read_bytes,
    sample_bits,
)
from slamcli.io.images.light import StaticLight
from slamcli.io.images.own import is_marked
from slamcli.io.picture_files import Listed, listed, stamped
from slamcli.io.sequences import sequence_of

IMAGE_SUFFIXES = frozenset(
    {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
)
# Of drives that were simulated or extracted, and of TUM's sequences.
_INNER_FOLDERS = ("frames", "rgb")
# Of a camera's card, whose folders hold the pictures (DCF): 100MEDIA, 101MEDIA ...
_CAMERA_ROOT = "DCIM"
_DEEP_SUFFIXES = frozenset({".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff"})
_MAX_SAMPLE_BITS = 16


@dataclass(frozen=True, slots=True)
class FrameFile:
    """The file of a frame, not read yet.

    Attributes
    ----------
    index : int
        Number in the sequence, from 0.
    path : Path
    stamp : float or None
        Seconds, from the name or the frame rate.
    sample_bits : int
        Range of samples of more than 8 bits, the same for all frames of a run.
    camera_size : tuple of int or None
        Width and height of the run's camera, pixels: no picture of another size is decoded.
    digest : bytes
        Of the content that was read before; no other is accepted. Empty when none was.
    canvas : (int, int) or None
        Width and height that the picture is brought to when it has another size: see
        `images.canvas`.
    light : StaticLight or None
        A pattern that is taken out of the picture.
    part : Part or None
        Which picture of the file it is; None for a file that is one picture.
    """

    index: int
    path: Path
    stamp: float | None
    sample_bits: int = _MAX_SAMPLE_BITS
    camera_size: tuple[int, int] | None = None
    digest: bytes = b""
    canvas: tuple[int, int] | None = None
    light: StaticLight | None = None
    part: Part | None = None

    @property
    def name(self) -> str:
        """The file's name without its folder, or that of the part."""
        return self.path.name if self.part is None else self.part.name

    def size(self) -> tuple[int, int]:
        """Return the width and height that it declares, pixels, turned; raises FrameError."""
        if self.part is None:
            return read_size(self.path)
        if not all(self.part.size):
            raise FrameError("damaged: its header cannot be read")
        return self.part.size

    def content(self) -> bytes | UInt8Array:
        """Return what is decoded: an encoded picture or pixels; raises FrameError."""
        return read_bytes(self.path) if self.part is None else self.part.content()


def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a sort key under which frame2 comes before frame10."""
    parts = re.split(r"(\d+)", name.casefold())
    key = tuple(
        (1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts if part
    )
    return (*key, (0, 0, name))


def list_frames(
    sources: Sequence[Path],
    frame_rate: float | None = None,
    selection: FrameSelection | None = None,
    progress: Progress = silent,
) -> list[FrameFile]:
    """Return the pictures of folders, files, videos and bags, naturally sorted within each folder.

    A folder stands for the ``frames`` or ``rgb`` folder in it, a camera's card for all folders in
    its ``DCIM``, and a text file for the pictures that it lists: see `sequences`. What this program
    drew is no frame of a folder.

    Parameters
    ----------
    sources : folders, picture files, lists of them, videos or bags
    frame_rate : float or None
        Frames per second, to give stamps to frames whose names carry none, and to those of a video
        in place of its own.
    selection : FrameSelection or None
        Of the frames of videos and bags.
    progress : function
        Shows how far a video or a bag has been read.

    Raises
    ------
    InputError
        When a source does not exist, or there is no picture at all.
    """
    found: list[Listed] = []
    for source in sources:
        if not source.exists():
            raise InputError(f"{source} does not exist; give a folder of frames or image files")
        parts = parts_of(source, selection or FrameSelection(), progress)
        if parts is not None:
            # A frame rate takes their place.
            own = frame_rate is None
            found += [Listed(source, part, part.stamp if own else None) for part in parts]
        elif (sequence := sequence_of(source)) is not None:
            own = frame_rate is None and all(one.stamp is not None for one in sequence)
            bare = [Listed(one.path) for one in sequence]
            found += sequence if own else stamped(bare, frame_rate, ordered=True)
        elif source.is_dir():
            pictures = [one for path in _pictures_in(source) for one in listed(path)]
            found += stamped(pictures, frame_rate, ordered=False)
        else:
            found += listed(source)
    named = {source for source in sources if not is_container(source)}
    alone = [number for number, one in enumerate(found) if one.path in named]
    in_order = stamped([found[number] for number in alone], frame_rate, ordered=True)
    for number, one in zip(alone, in_order, strict=True):
        found[number] = one
    if not found:
        suffixes = " ".join(sorted(IMAGE_SUFFIXES))
        raise InputError(f"no images in {', '.join(map(str, sources))}; looked for {suffixes}")
    bits = _range_of([one.path for one in found if one.part is None])
    return [
        FrameFile(index, one.path, _stamp(one, index, frame_rate), bits, part=one.part)
        for index, one in enumerate(found)
    ]


def of_camera(files: Sequence[FrameFile], size: tuple[int, int]) -> list[FrameFile]:
    """Return the files, to be read as pictures of a camera of this width and height, pixels."""
    return [replace(file, camera_size=size) for file in files]


def read_frame(file: FrameFile, *, gray: bool = False, halved: bool = False) -> Frame:
    """Return the decoded frame; raises FrameError, also when its file changed since it was read.

    Parameters
    ----------
    gray : bool
        As (H, W), more quickly.
    halved : bool
        In colours, of half the size, more quickly: each pixel the mean of two by two. The mask
        stays whole.
    """
    data = file.content()
    digest = digest_of(data)
    if file.digest not in {b"", digest}:
        raise FrameError("the file has changed since it was read first")
    factor = 2 if halved and not gray else 1
    image, mask = _decoded(file, data, gray=gray, factor=1 if file.canvas else factor)
    image = image if file.light is None else file.light.evened(image)
    if file.canvas is not None:
        image, mask = canvas.on_canvas(image, mask, file.canvas)
        image = canvas.halved(image) if factor == 2 else image
    return Frame(file.index, file.name, file.stamp, image, mask, digest)


def read_reduced_gray(file: FrameFile) -> UInt8Array:
    """Return the frame as (h, w) gray of a quarter of its size, quickly; raises FrameError."""
    return _decoded(file, file.content(), gray=True, factor=4)[0]


def read_size(path: Path) -> tuple[int, int]:
    """Return the width and height that a picture's header declares, turned; raises FrameError."""
    return picture_size(read_bytes(path))


def read_image(path: Path) -> UInt8Array:
    """Return a picture as (H, W, 3) uint8 BGR, turned as its EXIF orientation says.

    Of 16-bit samples the upper 8 bits of the picture's range are kept (10, 12, 14 or 16 bits), gray
    is repeated, CMYK converted, and transparency dropped.

    Raises
    ------
    FrameError
        When the file is missing, empty, damaged, too small, too large or no picture.
    """
    return decode(read_bytes(path), Reading())[0]


def _decoded(
    file: FrameFile, data: bytes | UInt8Array, *, gray: bool, factor: int
) -> tuple[UInt8Array, UInt8Array | None]:
    reading = Reading(gray, factor, file.sample_bits, file.camera_size)
    return decode(data, reading) if isinstance(data, bytes) else (from_pixels(data, reading), None)


def _pictures_in(folder: Path) -> list[Path]:
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise InputError(f"cannot list {folder}: {error.strerror or error}") from error
    for inner in (folder / name for name in _INNER_FOLDERS):
        if inner.is_dir() and inner in entries:
            return _pictures_in(inner)
    if folder / _CAMERA_ROOT in entries and (folder / _CAMERA_ROOT).is_dir():
        return _pictures_in(folder / _CAMERA_ROOT)
    if folder.name == _CAMERA_ROOT:
        inside = sorted(filter(Path.is_dir, entries), key=lambda path: natural_key(path.name))
        return [picture for one in inside for picture in _pictures_in(one)]
    suffixes = IMAGE_SUFFIXES | (HEIC_SUFFIXES if can_read_heic() else frozenset())
    pictures = [
        path
        for path in entries
        if path.suffix.lower() in suffixes
        and not path.name.startswith(".")
        and not path.is_dir()
        and not is_marked(path)
    ]
    heic = next((path for path in entries if path.suffix.lower() in HEIC_SUFFIXES), None)
    if heic is not None and not pictures:
        heic_picture(heic)
    return sorted(pictures, key=lambda path: natural_key(path.name))


def _stamp(one: Listed, index: int, frame_rate: float | None) -> float | None:
    if one.stamp is not None or frame_rate is None:
        return one.stamp
    return index / frame_rate


def _range_of(paths: Sequence[Path]) -> int:
    """Return the range of the frames' samples, bits: 12 bits in 16 are to be no black."""
    first = _sample_bits(paths[0]) if paths else None
    if first is None:
        return _MAX_SAMPLE_BITS
    # A first frame that is dark must not make the others white.
    others = (_sample_bits(paths[number]) for number in {len(paths) // 2, len(paths) - 1})
    return max(first, *(bits or 0 for bits in others))


def _sample_bits(path: Path) -> int | None:
    if path.suffix.lower() not in _DEEP_SUFFIXES:
        return None
    try:
        return sample_bits(read_bytes(path))
    except FrameError:  # it becomes the frame's reason when it is read
        return None
