"""A short part of `make faults`; the whole list of cases is in faults.py."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import faults
import pytest
from faults import Drive, Outcome

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    return Drive(tmp_path_factory.mktemp("faults"), "640x480", 4)


@pytest.mark.parametrize(
    "fault",
    [
        lambda drive, output: faults.kill(drive, output, 3.5, (signal.SIGKILL,)),
        lambda drive, output: faults.kill(drive, output, 6.5, (signal.SIGINT, signal.SIGINT)),
        lambda drive, output: faults.full_file(drive, output, 300_000),
        lambda drive, output: faults.vanished(drive, output, "painting"),
        lambda drive, output: faults.two_runs(drive, output, "locating"),
    ],
    ids=["killed", "interrupted twice", "full", "frames vanish", "two runs"],
)
def test_a_fault_costs_nothing(
    drive: Drive, tmp_path: Path, fault: Callable[[Drive, Path], Outcome]
) -> None:
    outcome = fault(drive, tmp_path / "cut")
    assert outcome.clean, outcome
    assert outcome.same, outcome
