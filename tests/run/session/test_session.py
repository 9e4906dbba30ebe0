"""A session shows progress in order, keeps local work local, and stops between two steps."""

from __future__ import annotations

import os
import signal

import pytest

from slamcli.run.session.interruption import Interruption
from slamcli.run.session.session import Session


@pytest.mark.parametrize("workers", [1, 3])
def test_a_stage_shows_each_result_once_it_is_used(workers: int) -> None:
    seen: list[object] = []
    use = seen.append
    session = Session(workers, progress=lambda *step: use(step))
    for number in session.stage("squaring", lambda item: item**2, [1, 2, 3]):
        use(number)
    assert seen == [
        1,
        ("squaring", 1, 3),
        4,
        ("squaring", 2, 3),
        9,
        ("squaring", 3, 3),
    ]


def test_work_on_this_machine_has_no_cluster_and_the_same_interruption() -> None:
    session = Session(2, "tcp://nowhere:1")
    here = session.on_this_machine()
    assert (here.workers, here.scheduler) == (2, "")
    assert here.interruption is session.interruption
    assert list(here.ordered(abs, [-1, 2])) == [1, 2]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_one_stage_and_a_second_one_at_once_ends_the_program(
    number: signal.Signals,
) -> None:
    said: list[str] = []
    interruption = Interruption(said.append)
    before = signal.getsignal(number)
    with interruption.on_signals():
        assert not interruption.stops_here()
        os.kill(os.getpid(), number)
        assert said == [
            "interrupted: stops after this step and writes what there is; once more: at once"
        ]
        assert interruption.stops_here()
        assert interruption.happened
        assert not interruption.stops_here()
        os.kill(os.getpid(), number)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
        # What is half-written is deleted without another interruption.
        os.kill(os.getpid(), number)
    assert signal.getsignal(number) == before
    assert not Session().interruption.happened


def test_a_signal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interruption().at_once():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
