"""Frames decoded once for all tiles around them, a limited number of them in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from threading import Lock

from slamcli.stages.mosaic.source_image import SourceImage


class FrameCache:
    """The pictures last used; may be shared by threads, and starts empty in another process.

    Memory that is touched for the first time costs more than decoding into it: a picture that no
    further tile needs makes room at once.

    Parameters
    ----------
    make : function
        From a number to its picture; called once for each that is not in memory.
    max_count : int
        How many are kept.
    uses : mapping or None
        How many tiles will be `done` with each number; None when it is not known.
    """

    def __init__(
        self,
        make: Callable[[int], SourceImage],
        max_count: int,
        uses: Mapping[int, int] | None = None,
    ) -> None:
        self._make = make
        self._max_count = max(1, max_count)
        self._left = dict(uses or {})
        self._lock = Lock()
        self._kept: OrderedDict[int, Future[SourceImage]] = OrderedDict()

    def __reduce__(self) -> tuple[type[FrameCache], tuple[Callable[[int], SourceImage], int]]:
        # Which tiles another process will paint is not known.
        return FrameCache, (self._make, self._max_count)

    def __call__(self, number: int) -> SourceImage:
        """Return a picture, made now or kept from before."""
        with self._lock:
            future = self._kept.get(number)
            wanted = future is None
            if future is None:
                future = self._kept[number] = Future()
            self._kept.move_to_end(number)
            while len(self._kept) > self._max_count:
                self._kept.popitem(last=False)
        if wanted:
            try:
                future.set_result(self._make(number))
            except BaseException as error:
                future.set_exception(error)
                raise
        return future.result()

    def done(self, numbers: Iterable[int]) -> None:
        """Count one of the tiles that need these as painted."""
        with self._lock:
            for number in numbers:
                self._left[number] = self._left.get(number, 0) - 1
                if self._left[number] == 0:
                    self._kept.pop(number, None)
