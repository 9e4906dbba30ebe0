"""The outside data: real frames of the real course, and the thesis's simulated one."""

from __future__ import annotations

import csv
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from command_line import slam
from trajectories import read_poses, read_rows

from slamcli.io.calibrations import load_calibration

COURSE_CORNERS = "1242,513 1642,513 1890,570 1342,570"


def run(*arguments: object) -> str:
    result = slam(*arguments)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.slow
def test_the_real_course_is_one_map(data_folder: Path, tmp_path: Path) -> None:
    calibration = tmp_path / "calibration.yaml"
    photo = data_folder / "course" / "c01.jpg"
    run("calibrate", photo, "--corners", COURSE_CORNERS, "--side", "0.3048", "-o", calibration)
    assert 0.09 < load_calibration(calibration).height_metres < 0.14
    run("stitch", data_folder / "course", "-c", calibration, "-o", tmp_path / "map")
    rows = read_rows(tmp_path / "map" / "poses.csv")
    assert [row["status"] for row in rows] == ["tracked"] * 12
    assert {row["fragment"] for row in rows} == {"0"}
    poses = list(read_poses(tmp_path / "map" / "poses.csv").values())
    for before, after in pairwise(poses):
        step = before.inverse() @ after
        assert 0.01 < step.translation_length < 0.16
        assert abs(np.degrees(step.theta)) < 33
    total = poses[0].inverse() @ poses[-1]
    assert total.x > 0.3
    assert all(float(row["score"]) > 0.7 for row in rows[1:])


@pytest.mark.parametrize(
    ("name", "corners"),
    [
        ("cap6.jpg", [(922, 220), (688, 27), (276, 27), (7, 218)]),
        ("calibrate.jpg", None),
    ],
)
def test_the_simulated_square_is_found_without_help(
    data_folder: Path, tmp_path: Path, name: str, corners: list[tuple[int, int]] | None
) -> None:
    output = run("calibrate", data_folder / "gazebo" / name, "-o", tmp_path / "calibration.yaml")
    found = output.split("corners ")[1].split("\n")[0].split()
    places = np.array([[float(v) for v in pair.split(",")] for pair in found])
    if corners is None:
        assert len(places) == 4
        return
    distances = np.linalg.norm(places[:, None] - np.array(corners, float)[None], axis=2)
    assert distances.min(axis=0).max() < 2.0
    assert sorted(distances.argmin(axis=0)) == [0, 1, 2, 3]


def test_simulated_frames_that_do_not_overlap_are_not_placed(
    data_folder: Path, tmp_path: Path
) -> None:
    calibration = tmp_path / "calibration.yaml"
    run("calibrate", data_folder / "gazebo" / "cap6.jpg", "-o", calibration)
    frames = [data_folder / "gazebo" / f"cap{number}.jpg" for number in (1, 6)]
    run("stitch", *frames, "-c", calibration, "-o", tmp_path / "map")
    with (tmp_path / "map" / "poses.csv").open() as stream:
        statuses = [row["status"] for row in csv.DictReader(stream)]
    assert statuses == ["tracked", "lost"]
