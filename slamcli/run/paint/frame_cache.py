"""Frames decoded once for all tiles around them, at most so many in memory."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from threading import Lock

from slamcli.core.errors import InputError
from slamcli.stages.mosaic.source_image import SourceImage

_MIN_PICTURES = 4
# Linux tells of a process's pages here; the second number is of those in memory.
_RESIDENT = Path("/proc/self/statm")


class FrameCache:
    """The pictures last used; may be shared by threads, and starts anew in another process.

    Memory that is touched for the first time costs more than decoding into it: what no tile will
    ask for again makes room at once.

    Parameters
    ----------
    make : function
        From a number to its picture; called once for each that is not at hand.
    most : int
        How many are kept.
    uses : mapping or None
        How many tiles will be `done` with each number; None when it is not known.
    """

    def __init__(
        self, make: Callable[[int], SourceImage], most: int, uses: Mapping[int, int] | None = None
    ) -> None:
        self._make = make
        self._most = max(1, most)
        self._left = dict(uses or {})
        self._lock = Lock()
        self._kept: OrderedDict[int, Future[SourceImage]] = OrderedDict()

    def __reduce__(self) -> tuple[type[FrameCache], tuple[Callable[[int], SourceImage], int]]:
        # Which tiles another process will paint is not known.
        return FrameCache, (self._make, self._most)

    def __call__(self, number: int) -> SourceImage:
        """Return a picture, made now or kept from before."""
        with self._lock:
            future = self._kept.get(number)
            wanted = future is None
            if future is None:
                future = self._kept[number] = Future()
            self._kept.move_to_end(number)
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        if wanted:
            try:
                future.set_result(self._make(number))
            except BaseException as error:
                future.set_exception(error)
                raise
        return future.result()

    def done(self, numbers: Iterable[int]) -> None:
        """Take note that one of the tiles that need these is painted."""
        with self._lock:
            for number in numbers:
                self._left[number] = self._left.get(number, 0) - 1
                if self._left[number] == 0:
                    self._kept.pop(number, None)


def max_at_once(needed: Sequence[Sequence[int]]) -> int:
    """Return how many pictures are held when each is dropped after the last tile that needs it.

    Parameters
    ----------
    needed : sequence of sequence of int
        The numbers that each tile needs, in the tiles' order.
    """
    last = {number: place for place, numbers in enumerate(needed) for number in numbers}
    held: set[int] = set()
    most = 0
    for place, numbers in enumerate(needed):
        held |= set(numbers)
        most = max(most, len(held))
        held -= {number for number in numbers if last[number] == place}
    return most


def max_pictures(picture_bytes: int, memory_bytes: int, canvas_bytes: int, workers: int) -> int:
    """Return how many frames may be held beside all else that the process holds already.

    A few are held in any case: what the poses of a long drive take cannot be given back.

    Raises
    ------
    InputError
        When the memory would not do even for a process that holds nothing yet.
    """
    room = memory_bytes - canvas_bytes
    least = max(_MIN_PICTURES, 2 * workers)
    if room < least * picture_bytes:
        raise InputError(
            f"--memory {size_text(memory_bytes)} is too little to paint in; give "
            f"{size_text(canvas_bytes + least * picture_bytes)} or more, or fewer --workers"
        )
    return max(least, (room - _resident_bytes()) // picture_bytes)


def _resident_bytes() -> int:
    """Return the memory that this process takes; 0 where the system does not tell."""
    try:
        pages = _RESIDENT.read_text().split()[1]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def size_text(count: float) -> str:
    """Return a number of bytes for the eye."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"
