"""Values that are computed when they are first needed, if ever."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Deferred(Generic[T]):
    """A value that is computed once, when it is first needed.

    Threads may share it: those that need it at the same time compute the same value. A copy or a
    pickle has the value if it was computed, else the computation, which must then be picklable.

    Parameters
    ----------
    compute : function
        Depends on nothing but what it was made of, so that it does not matter when it is called.
    """

    __slots__ = ("_compute", "_value")

    _compute: Callable[[], T] | None
    _value: T

    def __init__(self, compute: Callable[[], T]) -> None:
        self._compute = compute

    @classmethod
    def of(cls, value: T) -> Deferred[T]:
        """Return a value that is known already."""
        known = cls(lambda: value)
        known._value, known._compute = value, None
        return known

    @property
    def value(self) -> T:
        """The value; whatever its computation raises is raised each time."""
        compute = self._compute
        if compute is not None:
            self._value = compute()
            # Only now, as another thread may be reading; what it was computed of is let go.
            self._compute = None
        return self._value
