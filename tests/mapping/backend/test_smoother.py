"""Fixed-lag smoothing: loops are closed as they are found, at a cost that stays flat."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PreparedFrame
from slamcli.mapping.backend.backend import Backend
from slamcli.stages import posegraph

SIGMA = 0.0005
OUT = 700
LOOP_EVERY = 20


def there_and_back(count: int) -> list[Pose2]:
    """Out along a line, and back beside it, seeing the same floor."""
    out = [Pose2(0.1 * n, 0.0, 0.0) for n in range(count)]
    return out + [Pose2(0.1 * n, 0.05, math.pi) for n in reversed(range(count))]


def drive(truth: list[Pose2], loops: dict[int, int]) -> Backend:
    """Steps with noise, and a loop from some frames on the way back to those on the way out."""
    generator = np.random.default_rng(4)
    backend = Backend()

    def link(a: int, b: int, kind: Any) -> Link:
        error = Pose2(*generator.normal(0.0, SIGMA, 3))
        motion = truth[a].inverse() @ truth[b] @ error
        return Link(a, b, motion, SIGMA**2 * np.eye(3), 50, 0.9, kind)

    for index in range(len(truth)):
        frame = PreparedFrame(index, str(index), None, None, None, "")
        if index == 0:
            backend.begin_fragment(frame)
            continue
        backend.place(frame, [link(index - 1, index, "step")])
        if index in loops:
            backend.add_links(index, [link(loops[index], index, "loop")])
    return backend


def errors(backend: Backend, truth: list[Pose2]) -> np.ndarray:
    graph = backend.graph
    return np.array([(t.inverse() @ graph.pose(i)).translation_length for i, t in enumerate(truth)])


def test_loops_are_closed_as_they_are_found_at_a_cost_that_stays_flat(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sizes: list[int] = []
    solve = posegraph.solve

    def counted(initial: dict[int, Pose2], *given: Any, **options: Any) -> posegraph.Solution:
        sizes.append(len(initial))
        return solve(initial, *given, **options)

    monkeypatch.setattr(posegraph, "solve", counted)
    truth = there_and_back(OUT)
    last = len(truth) - 1
    loops = {b: last - b for b in range(OUT + 5, last, LOOP_EVERY)}
    streamed = drive(truth, loops)
    assert len(sizes) > 10
    # The way out is long past when the first loops come back to its end: it is not solved anew.
    assert max(sizes[:3]) < 0.2 * OUT
    assert sum(sizes) < 12 * len(truth), "a frame of a window has been paid for by those that came"
    open_chain = drive(truth, {})
    ends = slice(last - 100, None)
    assert errors(streamed, truth)[ends].mean() < 0.3 * errors(open_chain, truth)[ends].mean()
    # Sigmas too: what a window leaves is no surer than the solution of the whole.
    latest = streamed.graph[last].covariance
    streamed.solve()
    whole = streamed.graph[last].covariance
    assert latest is not None
    assert whole is not None
    assert np.all(np.diag(latest) > 0.5 * np.diag(whole))


def test_what_lies_before_a_loop_stays_where_it_is() -> None:
    truth = there_and_back(200)
    last = len(truth) - 1
    first = 150
    backend = drive(truth, {})
    chain = [backend.graph.pose(index) for index in range(len(truth))]
    closed = drive(truth, {b: last - b for b in (last - first, last - first + 1)})
    assert [closed.graph.pose(index) for index in range(first - 1)] == chain[: first - 1]
    moved = [closed.graph.pose(index) for index in range(first + 1, last - first)]
    assert moved != chain[first + 1 : last - first]
