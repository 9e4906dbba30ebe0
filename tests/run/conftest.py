"""Fixtures of the commands' tests."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from command_line import slam


@pytest.fixture(scope="session")
def drive(samples_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames of the sample, with their calibration."""
    folder = tmp_path_factory.mktemp("drive")
    for index in range(5):
        shutil.copy(samples_folder / "course" / "frames" / f"{index:04d}.jpg", folder)
    square = samples_folder / "course" / "square.png"
    result = slam("calibrate", square, "-o", folder / "calibration.yaml")
    assert result.exit_code == 0, result.output
    (folder / "calibration.png").unlink()
    return folder
