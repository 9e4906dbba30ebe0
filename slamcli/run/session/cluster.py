"""The cluster: work on other processes and machines, through Dask.

Each worker gets a function once and keeps it, with all that it refers to; the results of a worker
that dies are computed anew on another. Frames are sent by path: every machine must find
them under the same one.
"""

from __future__ import annotations

import logging
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

import cv2

from slamcli.core.errors import InputError

# The function travels with the first task that needs it, some megabytes of it.
_QUIET = {"distributed.admin.large-graph-warning-threshold": "1GB"}
_CONNECT_SECONDS = 8
# How long a cluster may have no worker, or a scheduler that does not answer: a worker that is
# restarted is back in less, and a run on a busy machine ends within 30 s all the same.
# [guarded by tests/run/session/test_cluster.py]
_PATIENCE_SECONDS = 6.0
_POLL_SECONDS, _ANSWER_SECONDS, _CLOSE_SECONDS = 1.0, 3, 1
# A frame that kills more workers than this fails the run.
_MAX_DEATHS = 4
# What they log about a lost connection is one line of this program.
_LOGGERS = ("distributed", "distributed.client", "tornado.application", "asyncio")

Result = TypeVar("Result")


class Cluster(Executor):
    """A Dask cluster as `concurrent.futures` sees it.

    Parameters
    ----------
    client : distributed.Client
    address : str
        Of the scheduler.
    """

    def __init__(self, client: Any, address: str) -> None:
        self._client = client
        self._address = address
        self._executor = client.get_executor(pure=False, retries=_MAX_DEATHS)
        self._kept: dict[Callable[..., Any], Any] = {}
        self._submitted: WeakKeyDictionary[Future[Any], Callable[[], Future[Any]]] = (
            WeakKeyDictionary()
        )

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Schedule ``fn(*args)``; `fn` is sent only once.

        Raises
        ------
        InputError
            When the connection to the scheduler is lost.
        """
        if self._client.status not in {"running", "connecting"}:
            raise self._lost()
        if fn not in self._kept:
            # As the result of a task, not as data: a worker that dies with it is no loss.
            self._kept[fn] = self._client.submit(_same, _Wrapped(fn), pure=False)
        future: Future[Any] = self._executor.submit(_call, self._kept[fn], *args, **kwargs)
        self._submitted[future] = partial(self.submit, fn, *args, **kwargs)
        return future

    def result(self, future: Future[Result]) -> Result:
        """Wait for a result, as long as there are workers.

        Raises
        ------
        InputError
            When the scheduler or all workers are gone, or the task has killed several of them.
        """
        from distributed import KilledWorker

        waits_since = time.monotonic()
        while True:
            try:
                return future.result(_POLL_SECONDS)
            except CancelledError as error:
                raise self._lost() from error
            except KilledWorker as error:
                raise InputError(
                    f"a frame has ended {_MAX_DEATHS} workers of the cluster; they lack memory"
                ) from error
            except TimeoutError:
                if future.done():
                    raise
            except Exception as error:
                if not _lost_on_arrival(error):
                    raise
                future = self._submitted[future]()
            workers = self._count_workers()
            if workers:
                waits_since = time.monotonic()
            elif time.monotonic() - waits_since > _PATIENCE_SECONDS:
                raise self._lost() if workers is None else self._idle()

    def _count_workers(self) -> int | None:
        """Return how many workers there are; None when the scheduler does not answer."""
        # None while Dask tries to connect again.
        scheduler = self._client.scheduler
        if scheduler is not None:
            with suppress(OSError):
                identity = self._client.sync(scheduler.identity, callback_timeout=_ANSWER_SECONDS)
                return len(identity["workers"])
        return None

    def _lost(self) -> InputError:
        return InputError(f"the Dask scheduler at {self._address} does not answer any more")

    def _idle(self) -> InputError:
        return InputError(
            f"the Dask scheduler at {self._address} has no workers; start one with "
            f"`dask worker {self._address}`"
        )

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: FBT001, FBT002
        """Wait for what was submitted, or cancel it."""
        self._executor.shutdown(wait=wait and not cancel_futures)

    @property
    def processors(self) -> int:
        """How many tasks run at once."""
        threads: dict[str, int] = self._client.nthreads()
        return max(1, sum(threads.values()))


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """Yield the cluster of a scheduler, such as ``tcp://host:8786``.

    Raises
    ------
    InputError
        When distributed is not installed, or no scheduler answers.
    """
    try:
        import dask
        import distributed
    except ImportError as error:
        raise InputError("--scheduler needs Dask: pip install slamcli[cluster]") from error
    _silence()
    with dask.config.set(_QUIET):
        try:
            client: Any = distributed.Client(  # type: ignore[no-untyped-call]
                address, timeout=_CONNECT_SECONDS, set_as_default=False
            )
        except (OSError, ValueError) as error:
            raise InputError(
                f"no Dask scheduler answers at {address}; start one with `dask scheduler`, and "
                "`dask worker ADDRESS` on every machine"
            ) from error
        try:
            yield Cluster(client, address)
        finally:
            client.close(timeout=_CLOSE_SECONDS)


def _silence() -> None:
    """Keep the logs of Dask off the terminal, also those that it writes after its end."""
    for name in _LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL)


def _lost_on_arrival(error: Exception) -> bool:
    """Return whether a result's worker died between its arrival and its being noted as finished.

    Dask takes such a result for an error, and fails when it unpacks it.
    """
    return traceback.extract_tb(error.__traceback__)[-1].name == "_cascade_future"


class _Wrapped:
    """A function inside of an object: Dask would take the bare one for a task."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function


def _same(wrapped: _Wrapped) -> _Wrapped:
    return wrapped


def _call(wrapped: _Wrapped, *arguments: Any) -> Any:
    cv2.setNumThreads(1)
    return wrapped.function(*arguments)
