"""No command writes over what it reads, whatever the output is called."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from command_line import slam

INPUT = "is an input of this command"


@pytest.fixture
def drive(samples_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with frames as PNG-named files, their calibration, and a photo of a square."""
    course = samples_folder / "course"
    for index in range(2):
        shutil.copy(course / "frames" / f"{index:04d}.jpg", tmp_path / f"{index:04d}.png")
    shutil.copy(course / "camera.yaml", tmp_path / "calibration.yaml")
    shutil.copy(course / "frames" / "0002.jpg", tmp_path / "square.png")
    shutil.copy(course / "frames" / "0002.jpg", tmp_path / "mosaic.png")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("calibrate square.png -o square.yaml", INPUT),
        ("calibrate --refine 0000.png 0001.png -c calibration.yaml -o calibration.yaml", INPUT),
        ("warp . -o .", INPUT),
        ("stitch . -o .", INPUT),
        ("match 0000.png 0001.png -o 0001.png", INPUT),
        ("match 0000.png 0001.png -o link.png", "it is a link; name "),
        ("calibrate square.png -o device.yaml", "it is a device or the like"),
        ("stitch 0000.png 0001.png -o linked", "it is a link; name "),
        ("simulate device.yaml", "it is a device or the like"),
    ],
)
def test_an_output_over_an_input_is_refused_and_nothing_touched(
    drive: Path, words: str, reason: str
) -> None:
    (drive / "link.png").symlink_to("elsewhere.png")
    (drive / "linked").symlink_to(drive)
    os.mkfifo(drive / "device.yaml")
    before = {path: path.read_bytes() for path in drive.iterdir() if path.is_file()}
    names = sorted(drive.iterdir())
    result = slam(*words.split(), "--overwrite")
    assert result.exit_code == 1, result.output
    assert reason in result.output
    assert result.output.count("\n") == 1
    assert sorted(drive.iterdir()) == names
    assert {path: path.read_bytes() for path in before} == before
