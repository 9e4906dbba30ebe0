"""A run that was cut off: what is left of it, and how it is resumed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
from command_line import slam

from slamcli.io.checkpoints import Checkpoint, run_key

COARSE = ("--metres-per-pixel", "0.004")


def command(drive: Path, output: Path, *more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "slamcli",
        "stitch",
        str(drive),
        "-o",
        str(output),
        *COARSE,
        *more,
    ]


@pytest.mark.parametrize("stage", ["locating 3/5", "painting 2/"])
def test_a_killed_run_goes_on_to_the_same_bytes(drive: Path, tmp_path: Path, stage: str) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert slam("stitch", drive, "-o", whole, *COARSE).exit_code == 0
    process = subprocess.Popen(command(drive, cut), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(stage):
            break
    process.kill()
    process.wait()
    process.stderr.close()
    assert not (cut / "poses.csv").exists()
    result = slam("stitch", drive, "-o", cut, "--resume", *COARSE)
    assert result.exit_code == 0, result.output
    if stage.startswith("painting"):
        assert "5 of 5 frames had been located" in result.output
        assert "locating" not in result.output
    names = sorted(path.name for path in whole.iterdir())
    assert names == sorted(path.name for path in cut.iterdir())
    for name in names:
        assert (whole / name).read_bytes() == (cut / name).read_bytes(), name


def test_ctrl_c_ends_with_what_is_there_and_can_be_gone_on_with(
    drive: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut"
    with subprocess.Popen(
        command(drive, cut), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        for line in process.stderr:
            if line.startswith("locating 2/5"):
                os.kill(process.pid, signal.SIGINT)
                break
        process.stderr.read()
        printed = process.stdout.read()
    assert process.returncode == 130
    assert "interrupted" in printed
    rows = (cut / "poses.csv").read_text().splitlines()
    assert len(rows) == 6
    assert "not reached: interrupted" in rows[-1]
    assert cv2.imread(str(cut / "mosaic.png"), cv2.IMREAD_UNCHANGED)[..., 3].any()
    result = slam("stitch", drive, "-o", cut, "--resume", *COARSE)
    assert result.exit_code == 0, result.output
    assert "placed       5 (100%)" in result.output
    assert not (cut / ".resume").exists()


def test_a_state_of_another_run_is_not_gone_on_with(tmp_path: Path) -> None:
    first = run_key("a", [tmp_path])
    checkpoint = Checkpoint(tmp_path)
    checkpoint.open(first, resume=False)
    checkpoint.save({"frames": 3})
    assert Checkpoint(tmp_path).open(first, resume=True)
    checkpoint = Checkpoint(tmp_path)
    assert checkpoint.open(first, resume=True)
    assert checkpoint.load() == {"frames": 3}
    assert not Checkpoint(tmp_path).open(run_key("b", [tmp_path]), resume=True)
    assert not checkpoint.folder.exists()


def test_a_state_cannot_bring_foreign_code(tmp_path: Path) -> None:
    checkpoint = Checkpoint(tmp_path)
    checkpoint.open("key", resume=False)
    checkpoint.save(time.sleep)
    assert checkpoint.load() is None
