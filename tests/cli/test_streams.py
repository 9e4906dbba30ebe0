"""Results are written all the same when nothing can be printed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

WORDS = [sys.executable, "-m", "slamcli", "stitch"]
FULL = Path("/dev/full")


@pytest.fixture
def drive(samples_folder: Path, tmp_path: Path) -> list[str]:
    """The words of a small stitch."""
    course = samples_folder / "course"
    frames = [str(course / "frames" / f"{index:04d}.jpg") for index in range(3)]
    camera = ["-c", str(course / "camera.yaml"), "--metres-per-pixel", "0.004"]
    return [*WORDS, *frames, *camera, "-o", str(tmp_path / "out")]


def run(command: list[str], redirection: str) -> subprocess.CompletedProcess[str]:
    words = ["sh", "-c", f'"$@" {redirection}', "sh", *command]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.mark.skipif(os.name == "nt", reason="needs a shell")
@pytest.mark.parametrize(
    ("redirection", "code"),
    [
        (">&-", 0),
        ("2>&-", 0),
        ("<&- >&- 2>&-", 0),
        (">/dev/full", 1),
        ("2>/dev/full", 0),
        (">/dev/full 2>/dev/full", 1),
    ],
)
def test_results_are_written_where_nothing_can_be_printed(
    drive: list[str], tmp_path: Path, redirection: str, code: int
) -> None:
    if "full" in redirection and not FULL.exists():
        pytest.skip("no /dev/full")
    done = run(drive, redirection)
    assert done.returncode == code, done.stderr
    if redirection == ">/dev/full":
        assert done.stderr.endswith("Error: cannot print the result: No space left on device\n")
    assert "Traceback" not in done.stderr
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names >= {"mosaic.png", "poses.csv", "map.slam", "run.toml"}
    assert ".resume" not in names
    rows = (tmp_path / "out" / "poses.csv").read_text().splitlines()
    assert len(rows) == 4
    assert all(row.count(",") == rows[0].count(",") for row in rows)


@pytest.mark.parametrize("stream", ["stdout", "stderr", "both"])
def test_results_are_written_when_the_reader_has_seen_enough(
    drive: list[str], tmp_path: Path, stream: str
) -> None:
    read, write = os.pipe()
    os.close(read)
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    streams |= {name: write for name in streams if stream in {name, "both"}}
    done = subprocess.run(drive, **streams, check=False, text=True)  # type: ignore[call-overload]
    os.close(write)
    assert done.returncode == 0
    assert "Traceback" not in (done.stderr or "")
    assert (tmp_path / "out" / "mosaic.png").is_file()
