"""The lock on an output folder."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamcli.core.errors import OutputError
from slamcli.io.locks import LOCK_NAME
from slamcli.io.outputs import output_folder

HOLD = """
import sys
from pathlib import Path
from slamcli.io.outputs import locked_folder
with locked_folder(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_a_second_run_into_a_folder_is_refused_until_the_first_has_ended(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "locked\n"
        with (
            pytest.raises(OutputError, match=rf"process {first.pid} on .*writes into .*; wait"),
            output_folder(tmp_path, (), inputs=(), overwrite=True),
        ):
            pass
        # A lock that a killed run leaves behind is none.
        os.kill(first.pid, signal.SIGKILL)
    assert (tmp_path / LOCK_NAME).exists()
    with output_folder(tmp_path, (), inputs=(), overwrite=False):
        assert (tmp_path / LOCK_NAME).exists()
    assert list(tmp_path.iterdir()) == []


def test_two_runs_of_one_process_exclude_each_other_too(tmp_path: Path) -> None:
    with (
        output_folder(tmp_path, (), inputs=(), overwrite=False),
        pytest.raises(OutputError, match="another run"),
        output_folder(tmp_path, (), inputs=(), overwrite=False),
    ):
        pass
