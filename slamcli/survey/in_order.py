"""How a survey's independent pieces of work are run: in order, perhaps ahead and in parallel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


class InOrder(Protocol):
    """Works as `map` does; may work ahead."""

    def __call__(
        self, work: Callable[[Item], Result], items: Sequence[Item], /
    ) -> Iterable[Result]:
        """Yield ``work(item)`` in the items' order."""
