"""The examples: each runs on the samples that the repository ships, a few frames of them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FRAMES = ROOT / "samples" / "course" / "frames"
EXAMPLES = sorted(path.stem for path in (ROOT / "examples").glob("*.py"))


def run(example: str, *arguments: object) -> str:
    """Return what an example prints."""
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / f"{example}.py"), *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of the sample drive, by the command that the README shows."""
    path = tmp_path_factory.mktemp("calibration") / "calibration.yaml"
    command = [sys.executable, "-m", "slamcli", "calibrate", "samples/course/square.png"]
    subprocess.run([*command, "-o", str(path)], cwd=ROOT, check=True, capture_output=True)
    return path


def test_every_example_is_tested() -> None:
    tests = Path(__file__).read_text(encoding="utf-8")
    assert EXAMPLES
    for example in EXAMPLES:
        assert f'run("{example}"' in tests


def test_stream_from_camera(calibration: Path) -> None:
    lines = run("stream_from_camera", FRAMES, calibration, "--frames", 4).splitlines()
    assert len(lines) == 5
    assert lines[1].startswith("frame 1: tracked x 0.079")
    assert lines[-1].startswith("4 of 4 frames placed")


def test_map_a_folder_and_localise_in_it(calibration: Path, tmp_path: Path) -> None:
    frames = [FRAMES / f"{number:04}.jpg" for number in range(4)]
    (tmp_path / "frames").mkdir()
    for path in frames[:3]:
        (tmp_path / "frames" / path.name).write_bytes(path.read_bytes())
    lines = run("map_a_folder", tmp_path / "frames", calibration, tmp_path / "out").splitlines()
    assert [line.split(":")[0] for line in lines if ": x " in line] == [p.name for p in frames[:3]]
    assert (tmp_path / "out" / "mosaic.png").exists()
    found = run("localise_in_a_map", tmp_path / "out" / "map.slam", *frames[1:3]).splitlines()
    assert found[0].startswith("0001.jpg: x 0.079")
    assert found[1].startswith("0002.jpg: x 0.157")


def test_evaluate_against_truth(calibration: Path) -> None:
    folder = ROOT / "samples" / "course"
    printed = run("evaluate_against_truth", folder, calibration, "--frames", 5, "--limit-mm", 1)
    assert "ATE 0." in printed
