"""The five journeys of the benchmark, over a short drive: every frame placed, the errors small."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.mark.slow
@pytest.mark.parametrize("name", ["video", "ros2", "ros1", "drone", "live"])
def test_a_first_command_maps_what_a_user_has(name: str, tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "benchmarks" / "journeys.py"), "--frames", "40"]
    done = subprocess.run(
        [*command, "--only", name, "--transcripts"],
        env={**os.environ, "PYTHONPATH": str(ROOT), "SLAMCLI_DRIVES": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{name}: " in done.stdout
    assert "Traceback" not in done.stdout
