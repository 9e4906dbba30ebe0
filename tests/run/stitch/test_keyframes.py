"""Frames are located in maps whose poses were not tracked: of surveys, and self-calibrated ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam
from flights import floor_picture, nadir_states, photographs
from trajectories import read_rows

from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.io.calibrations import load_calibration, save_calibration


def distances(folder: Path, located: Path) -> list[float]:
    """Return how far every frame was located from its pose in the map; each must be there."""
    poses, found = read_rows(folder / "poses.csv"), read_rows(located)
    assert [row["status"] for row in found] == ["tracked"] * len(poses)
    both = zip(poses, found, strict=True)
    return [float(np.hypot(*(float(a[axis]) - float(b[axis]) for axis in "xy"))) for a, b in both]


def test_frames_are_located_in_the_map_of_a_survey(tmp_path: Path) -> None:
    states = nadir_states(1, 3, np.random.default_rng(1))
    # A frame is located as one of the mean height that looks straight down.
    states[:, 3:] *= 0.2
    (tmp_path / "frames").mkdir()
    for number, picture in enumerate(photographs(floor_picture(), states)):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), picture)
    made = slam("stitch", tmp_path / "frames", "-o", tmp_path / "map")
    assert made.exit_code == 0, made.output
    out = tmp_path / "located.csv"
    result = slam("locate", tmp_path / "map", tmp_path / "frames", "-o", out)
    assert result.exit_code == 0, result.output
    assert max(distances(tmp_path / "map", out)) < 2.0


@pytest.mark.slow
def test_frames_are_located_in_a_self_calibrated_map(tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    slam("simulate", drive, "--frames", "14", "--path", "loop", "--length", "2")
    true = load_calibration(drive / "camera.yaml")
    matrix = true.camera_matrix @ np.diag([1.04, 1.04, 1.0])
    pitch = true.pitch_radians + 0.01
    wrong = replace(
        true,
        camera_matrix=matrix,
        pitch_radians=pitch,
        robot_from_image=compose_robot_from_image(
            matrix, true.height_metres, pitch, true.roll_radians, true.ahead_radians
        ),
    )
    save_calibration(tmp_path / "wrong.yaml", wrong)
    output = tmp_path / "map"
    made = slam("stitch", drive / "frames", "-c", tmp_path / "wrong.yaml", "-o", output)
    assert "refined" in made.output
    out = tmp_path / "located.csv"
    result = slam("locate", output, drive / "frames", "-o", out)
    assert result.exit_code == 0, result.output
    assert max(distances(output, out)) < 0.003
