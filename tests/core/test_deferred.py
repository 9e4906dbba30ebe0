"""Deferred values: computed once, when they are first needed."""

from __future__ import annotations

import pickle

import pytest

from slamcli.core.deferred import Deferred

CALLS: list[str] = []


def answer() -> int:
    CALLS.append("answer")
    return 42


def fail() -> int:
    CALLS.append("fail")
    raise ValueError("no value")


def test_a_value_is_computed_once_and_only_when_it_is_needed() -> None:
    CALLS.clear()
    deferred = Deferred(answer)
    assert not CALLS
    assert (deferred.value, deferred.value) == (42, 42)
    assert CALLS == ["answer"]


def test_a_known_value_is_not_computed() -> None:
    assert Deferred.of([1]).value == [1]


def test_a_copy_has_the_value_or_the_computation() -> None:
    CALLS.clear()
    deferred = Deferred(answer)
    assert pickle.loads(pickle.dumps(deferred)).value == 42
    assert deferred.value == 42
    assert pickle.loads(pickle.dumps(deferred)).value == 42
    assert CALLS == ["answer", "answer"]


def test_a_failure_is_raised_each_time() -> None:
    CALLS.clear()
    deferred = Deferred(fail)
    for _ in range(2):
        with pytest.raises(ValueError, match="no value"):
            deferred.value  # noqa: B018
    assert CALLS == ["fail", "fail"]
