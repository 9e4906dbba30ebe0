"""Work done ahead of its turn: pure functions on threads, results in order."""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Protocol, TypeVar

import cv2

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import Future

Item = TypeVar("Item")
Result = TypeVar("Result")


class Progress(Protocol):
    """Told after each step of a stage of the work."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note that `done` of `total` steps of `stage` are finished."""


def default_workers() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Iterator[Result]:
    """Yield ``function(item)`` in order, computed at most a few items ahead on `workers` threads.

    OpenCV's own threads are switched off meanwhile: the frames already fill the processors, and
    results must not depend on how a kernel was split.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pending: deque[Future[Result]] = deque()
    try:
        with ThreadPoolExecutor(workers) as executor:
            try:
                for item in items:
                    pending.append(executor.submit(function, item))
                    if len(pending) > 2 * workers:
                        yield pending.popleft().result()
                while pending:
                    yield pending.popleft().result()
            finally:
                for future in pending:
                    future.cancel()
    finally:
        cv2.setNumThreads(before)
