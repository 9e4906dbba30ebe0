"""A lock whose owner may be copied and pickled, to prepare frames on other machines."""

from __future__ import annotations

from threading import RLock


class ReentrantLock:
    """A lock that the thread which has it may take again; a copy is another one, free."""

    def __init__(self) -> None:
        self._lock = RLock()

    def __reduce__(self) -> tuple[type[ReentrantLock], tuple[()]]:
        return ReentrantLock, ()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_error: object) -> None:
        self._lock.release()
