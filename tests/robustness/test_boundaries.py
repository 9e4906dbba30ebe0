"""A short part of the boundaries that `make fuzz` tries; the whole list is in boundaries.py."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("av")


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(sys, "getdlopenflags"), reason="forks")
@pytest.mark.parametrize("match", ["stitch --metres", "gps.csv latitude, line 2", "--side="])
def test_extreme_values_end_clean_or_with_a_reason(tmp_path: Path, match: str) -> None:
    script = Path(__file__).with_name("boundaries.py")
    words = [sys.executable, str(script), str(tmp_path), f"--match={match}"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| 0 | 0 | 0 | 0 |" in done.stdout
