"""The session of a command: its executor, its progress display and its interruption, as one record.

None of it changes a result: a command writes the same bytes with any session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Protocol, Self, TypeVar

from slamcli.run.session import executor
from slamcli.run.session.interruption import Interruption

Item = TypeVar("Item")
Result = TypeVar("Result")


class Progress(Protocol):
    """A display of how far each stage of the work is."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of `stage` are finished."""


def _silent(*_: object, **__: object) -> None:
    """Show nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """How a command runs; by default on one thread, silently.

    Attributes
    ----------
    workers : int
        Threads.
    scheduler : str
        Address of a Dask scheduler, whose workers take the threads' place; empty for none.
    progress : Progress
        Called after each step of a stage.
    notify : function
        Prints one line that is no result.
    interruption : Interruption
        The requests to stop: Ctrl-C, SIGTERM, SIGHUP.
    """

    workers: int = 1
    scheduler: str = ""
    progress: Progress = field(default=_silent, repr=False)
    notify: Callable[[str], None] = field(default=_silent, repr=False)
    interruption: Interruption = field(default_factory=Interruption, repr=False)

    def ordered(self, work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """Yield ``work(item)`` in the items' order, computed a few items ahead.

        Raises
        ------
        InputError
            When the cluster cannot be reached.
        """
        return executor.ordered(work, items, self.workers, self.scheduler)

    def stage(
        self, name: str, work: Callable[[Item], Result], items: Sequence[Item]
    ) -> Iterator[Result]:
        """Yield as `ordered` does, and show each item's result, once it is used, as progress."""
        for done, result in enumerate(self.ordered(work, items), start=1):
            yield result
            self.progress(name, done, len(items))

    def threads(self) -> AbstractContextManager[Executor]:
        """Return this machine's threads, as a context manager."""
        return executor.threads(self.workers)

    def on_this_machine(self) -> Self:
        """Return the session without its cluster, for work on what only this machine has."""
        return replace(self, scheduler="")
