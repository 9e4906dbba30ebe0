"""`slam stitch --dry-run`: every kind of fault is found, and nothing is written."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
from command_line import slam


def test_a_dry_run_finds_what_is_wrong_and_writes_nothing(drive: Path, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    shutil.copytree(drive, frames)
    good = cv2.imread(str(frames / "0003.jpg"))
    cv2.imwrite(str(frames / "1446412345.jpg"), cv2.blur(good, (25, 25)))
    cv2.imwrite(str(frames / "1446412346.jpg"), good // 12)
    shutil.copy(frames / "0004.jpg", frames / "1446412346.5.jpg")
    shutil.copy(frames / "0004.jpg", frames / "1446412346.6.jpg")
    (frames / "1446412347.jpg").write_bytes(b"")
    cv2.imwrite(str(frames / "1446412348.png"), np.full_like(good, 255))
    output = tmp_path / "out"
    result = slam("stitch", frames, "-o", output, "--dry-run")
    assert result.exit_code == 0, result.output
    lines = [line for line in result.output.splitlines() if line.startswith("problem")]
    for kind, name in (
        ("blurred", "1446412345.jpg"),
        ("too dark", "1446412346.jpg"),
        ("same picture", "1446412346.6.jpg"),
        ("empty", "1446412347.jpg"),
        ("overexposed", "1446412348.png"),
    ):
        assert any(kind in line and name in line for line in lines), (kind, lines)
    assert not any("0001.jpg" in line for line in lines)
    assert "overlap" in result.output
    assert "Mpx" in result.output
    assert not output.exists()
    backwards = slam(
        "stitch",
        frames / "1446412346.5.jpg",
        frames / "1446412345.jpg",
        "--dry-run",
        "-c",
        drive / "calibration.yaml",
    )
    assert "stamp not after" in backwards.output
