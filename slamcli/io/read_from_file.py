"""What is read from a file and too large to be copied: a pickle of it is the file's path."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path


class ReadFromFile:
    """Something that a function returns from a file, such as a network.

    Workers of a cluster are sent the path and read the file again; printed, it is the path.

    Parameters
    ----------
    read : callable
        Of the path and the arguments.
    path : Path
    arguments
        Of `read`, after the path.
    """

    def __init__(self, read: Callable[..., object], path: Path, *arguments: object) -> None:
        self._read, self._path, self._arguments = read, path, arguments

    def __reduce__(self) -> tuple[object, ...]:
        return self._read, (self._path, *self._arguments)

    def __str__(self) -> str:
        return str(self._path)
