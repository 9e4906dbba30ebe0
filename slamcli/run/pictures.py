"""Frames decoded once for all tiles around them, at most so many in memory."""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future
from threading import Lock
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    from slamcli.stages.mosaic.sampling import Picture


class Pictures:
    """The pictures last used; may be shared by threads, and starts anew in another process.

    Parameters
    ----------
    make : function
        From a number to its picture; called once for each that is not at hand.
    most : int
        How many are kept.
    """

    def __init__(self, make: Callable[[int], Picture], most: int) -> None:
        self._make = make
        self._most = max(1, most)
        self._lock = Lock()
        self._kept: OrderedDict[int, Future[Picture]] = OrderedDict()

    def __reduce__(self) -> tuple[type[Pictures], tuple[Callable[[int], Picture], int]]:
        return Pictures, (self._make, self._most)

    def __call__(self, number: int) -> Picture:
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
