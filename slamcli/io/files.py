"""Atomic writing: into a temporary file beside the target, on the disk, then renamed into place."""

from __future__ import annotations

import codecs
import errno
import os
import stat
import tempfile
from collections.abc import Iterable
from pathlib import Path

import cv2

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import InputError, OutputError
from slamcli.core.names import readable
from slamcli.io.images.own import marked

# Of the folders whose files become results together; until then none of them is promised.
STAGING_PREFIX = ".partial-"
# More files than this are written to the disk by one call, which does so for the whole system.
_MAX_SYNCED_SINGLY = 64
_JPEG_QUALITY = 95

# Of tables and settings: more than a week of readings at a hundred a second.
_MAX_TEXT_BYTES = 512 * 2**20


def write_bytes(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Write a file completely or not at all; raises OutputError that names it."""
    write_chunks(path, [data], durable=durable)


def write_chunks(path: Path, chunks: Iterable[bytes], *, durable: bool = True) -> None:
    """Write a file from chunks, completely or not at all.

    Parameters
    ----------
    path : Path
    chunks : iterable of bytes
    durable : bool
        Also when the power fails; never so in a staging folder, none of which is promised yet.

    Raises
    ------
    OutputError
        Names the file.
    """
    durable = durable and not any(part.startswith(STAGING_PREFIX) for part in path.parts)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, beside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name[:40]}.")
        try:
            with os.fdopen(handle, "wb") as stream:
                for chunk in chunks:
                    stream.write(chunk)
                if durable:
                    stream.flush()
                    os.fsync(stream.fileno())
            # mkstemp makes the file private; a result is as readable as the user's umask allows.
            umask = os.umask(0)
            os.umask(umask)
            os.chmod(beside, 0o666 & ~umask)  # noqa: PTH101
            os.replace(beside, path)  # noqa: PTH105
            if durable:
                sync_folder(path.parent)
        except BaseException:
            Path(beside).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file completely or not at all."""
    write_bytes(path, readable(text).encode())


def write_drawing(path: Path, image: UInt8Array) -> None:
    """Write a picture as `write_image` does, with the mark of those that are no frames."""
    write_bytes(path, marked(_encoded(path, image, _JPEG_QUALITY)))


def write_image(
    path: Path, image: UInt8Array, *, jpeg_quality: int = _JPEG_QUALITY, durable: bool = True
) -> None:
    """Write gray, BGR or BGRA pixels; the format follows the name's suffix (.png, .jpg).

    A fast PNG compression is chosen, of differences from row to row: 5 % larger than at level 3, in
    less than half of its time.
    """
    write_bytes(path, _encoded(path, image, jpeg_quality), durable=durable)


def _encoded(path: Path, image: UInt8Array, jpeg_quality: int) -> bytes:
    if path.suffix.lower() in {".jpg", ".jpeg"}:
        parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    else:
        parameters = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER]
        parameters += [cv2.IMWRITE_PNG_FILTER_UP]
    encoded, data = cv2.imencode(path.suffix.lower(), image, parameters)
    if not encoded:
        raise OutputError(f"cannot write {path}: a picture of {image.shape} cannot be encoded")
    return data.tobytes()


def sync_files(folder: Path) -> None:
    """Write the files of a folder and of all folders in it to the disk, for a power failure.

    Raises
    ------
    OSError
    """
    paths = [path for path in folder.rglob("*") if path.is_file()]
    if len(paths) > _MAX_SYNCED_SINGLY and hasattr(os, "sync"):
        os.sync()
        return
    for path in paths:
        with path.open("rb+") as stream:
            os.fsync(stream.fileno())


def sync_folder(folder: Path) -> None:
    """Write a folder's list of names to the disk; without effect where folders cannot be opened."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        # Windows opens no folder.
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems sync no folder.
        if error.errno not in {errno.EINVAL, errno.EBADF}:
            raise
    finally:
        os.close(descriptor)


def fault_of_file(path: Path, max_bytes: int) -> str:
    """Return why a file is not to be opened; empty for a regular file of a bounded size.

    A pipe or a device may have no end.

    Raises
    ------
    OSError
        When there is no such file.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        return "it is a directory"
    if not stat.S_ISREG(status.st_mode):
        return "it is not a regular file"
    return f"it has more than {max_bytes >> 20} MB" if status.st_size > max_bytes else ""


def read_text(path: Path, what: str) -> str:
    """Return a text file's content; raises InputError that names it and says what it is."""
    try:
        reason = fault_of_file(path, _MAX_TEXT_BYTES)
        if not reason:
            data = path.read_bytes()
            wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
            text = data.decode("utf-16" if wide else "utf-8")
            return text.replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        reason = error.strerror or str(error)
    except UnicodeDecodeError:
        reason = "it is not UTF-8 text, nor UTF-16 with its mark"
    except ValueError:
        reason = "its name is not one of a file"
    raise InputError(f"cannot read the {what} {path}: {reason}")
