"""The cluster: work on other processes and machines, through Dask.

Each worker gets a function once and keeps it, with all that it refers to; the results of a worker
that dies are computed anew on another. Frames are sent by path: every machine must find
them under the same one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Any

import cv2

from slamcli.core.errors import InputError

# The function travels with the first task that needs it, some megabytes of it.
_QUIET = {"distributed.admin.large-graph-warning-threshold": "1GB"}
_CONNECT_SECONDS = 10
# A frame that kills more workers than this fails the run.
_MAX_DEATHS = 4


class Cluster(Executor):
    """A Dask cluster as `concurrent.futures` sees it.

    Parameters
    ----------
    client : distributed.Client
    """

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False, retries=_MAX_DEATHS)
        self._kept: dict[Callable[..., Any], Any] = {}

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Schedule ``fn(*args)``; `fn` is sent only once."""
        if fn not in self._kept:
            # As the result of a task, not as data: a worker that dies with it is no loss.
            self._kept[fn] = self._client.submit(_same, _Wrapped(fn), pure=False)
        future: Future[Any] = self._executor.submit(_call, self._kept[fn], *args, **kwargs)
        return future

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
        with client:
            yield Cluster(client)


class _Wrapped:
    """A function inside of an object: Dask would take the bare one for a task."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function


def _same(wrapped: _Wrapped) -> _Wrapped:
    return wrapped


def _call(wrapped: _Wrapped, *arguments: Any) -> Any:
    cv2.setNumThreads(1)
    return wrapped.function(*arguments)
