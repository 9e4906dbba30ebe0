"""The executor: pure functions run ahead on threads or on a cluster, with results in order."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import cv2

from slamcli.run.session.cluster import Cluster, connected

Item = TypeVar("Item")
Result = TypeVar("Result")


def default_workers() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int, scheduler: str = ""
) -> Iterator[Result]:
    """Yield ``function(item)`` in order, computed at most a few items ahead.

    OpenCV's own threads are switched off meanwhile: the frames already fill the processors, and
    results must not depend on how a kernel was split.

    Parameters
    ----------
    workers : int
        Threads.
    scheduler : str
        Address of a Dask scheduler, whose workers take the threads' place; function, items and
        results are then pickled.

    Raises
    ------
    InputError
        When the cluster cannot be reached, or is lost.
    """
    pending: deque[Future[Result]] = deque()
    with _alone(), _executor(workers, scheduler) as (executor, ahead):
        result = executor.result if isinstance(executor, Cluster) else Future[Result].result
        try:
            for item in items:
                pending.append(executor.submit(function, item))
                if len(pending) > ahead:
                    yield result(pending.popleft())
            while pending:
                yield result(pending.popleft())
        finally:
            for future in pending:
                future.cancel()


@contextmanager
def threads(workers: int) -> Iterator[Executor]:
    """Yield a pool of threads, OpenCV's own switched off meanwhile."""
    with _alone(), ThreadPoolExecutor(workers) as executor:
        yield executor


@contextmanager
def _alone() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@contextmanager
def _executor(workers: int, scheduler: str) -> Iterator[tuple[Executor, int]]:
    """Yield where to submit work, and how many items to be ahead by."""
    if scheduler:
        with connected(scheduler) as cluster:
            yield cluster, 2 * cluster.processors
    else:
        with ThreadPoolExecutor(workers) as executor:
            yield executor, 2 * workers
