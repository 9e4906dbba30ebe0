"""The lock on an output folder: one run at a time writes into it."""

from __future__ import annotations

import errno
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from slamcli.core.errors import OutputError

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LOCK_NAME = ".lock"
_HELD = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}
# The byte that is locked lies behind the text: Windows lets nobody read a locked byte.
_LOCKED_BYTE = 2**20
_MAX_OWNER_BYTES = 200


@contextmanager
def lock_on(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder that exists; a run that was killed leaves none.

    The operating system releases the lock of a process that ends, however it ends: a lock file that
    is left behind has no meaning by itself.

    Raises
    ------
    OutputError
        When another run has the lock, with its process and machine.
    OSError
        When no file can be made in the folder.
    """
    path = folder / LOCK_NAME
    descriptor = _open_locked(path, folder)
    try:
        # On a full disk the owner is not recorded; the lock is held all the same.
        with suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
    finally:
        # Windows deletes no file that is open.
        if sys.platform == "win32":
            os.close(descriptor)
            path.unlink(missing_ok=True)
        else:
            # On a disk that has become read-only the file stays; it has no meaning by itself.
            with suppress(OSError):
                path.unlink()
            os.close(descriptor)


def _open_locked(path: Path, folder: Path) -> int:
    """Return a descriptor of the lock file, locked."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            if not _try_lock(descriptor):
                owner = os.read(descriptor, _MAX_OWNER_BYTES).decode("utf-8", "replace").strip()
                raise OutputError(
                    f"another run ({owner or 'its process is not known'}) writes into {folder}; "
                    "wait for it, or name another --output"
                )
            if _is_same(descriptor, path):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        # The run before has deleted the file since it was opened: another may lock a new one.
        os.close(descriptor)


def _try_lock(descriptor: int) -> bool:
    """Lock a file; return whether it was free."""
    try:
        if sys.platform == "win32":
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _HELD:
            os.lseek(descriptor, 0, os.SEEK_SET)
            return False
        # Some network file systems have no locks; a run into one must still be possible.
        if error.errno not in {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}:
            raise
    return True


def _is_same(descriptor: int, path: Path) -> bool:
    """Return whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
