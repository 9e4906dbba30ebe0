"""A camera that looks ahead over a floor of lines, calibrated by the floor's pixels."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam
from trajectories import read_rows

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import Pose2
from slamcli.survey.features import local_detail
from slamcli.survey.oblique_by_pixels import camera_by_pixels
from slamcli.survey.photometric import LOG_FOCAL, PITCH, Alignment

WIDTH, HEIGHT = 320, 240
FOCAL, PITCH_RADIANS = 230.0, math.radians(33.0)
PIXELS_PER_HEIGHT = 150.0
LINES = [
    [(400, 250), (640, 330), (600, 440), (900, 560)],
    [(250, 200), (380, 420), (640, 520)],
    [(150, 300), (850, 180)],
]
TURNING = [Pose2(0.06 * n, -0.16 * n, -0.15 * n) for n in range(5)]


def pictures(poses: list[Pose2]) -> list[UInt8Array]:
    """Return what a camera of height 1 sees of white lines on black."""
    floor = np.zeros((1000, 1000), np.uint8)
    for line in LINES:
        cv2.polylines(floor, [np.array(line)], isClosed=False, color=200, thickness=22)
    metres_from_pixel = np.array(
        [[0.0, -1.0, 560.0], [-1.0, 0.0, 500.0], [0.0, 0.0, PIXELS_PER_HEIGHT]]
    )
    matrix = np.array([[FOCAL, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    image_from_robot = image_from_robot_homography(matrix, 1.0, PITCH_RADIANS, 0.0)
    noise = np.random.default_rng(0)
    found = []
    for pose in poses:
        image_from_floor = image_from_robot @ pose.inverse().matrix @ metres_from_pixel
        finer = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]]) @ image_from_floor
        large = cv2.warpPerspective(floor, finer, (4 * WIDTH, 4 * HEIGHT))
        seen = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        grainy = seen + noise.normal(8.0, 1.0, seen.shape)
        found.append(np.clip(grainy, 0, 255).astype(np.uint8))
    return found


def test_an_alignment_finds_camera_and_motions() -> None:
    details = [local_detail(one, None, WIDTH) for one in pictures(TURNING[:4])]
    motions = np.ravel([(0.9 * pose.x, 1.05 * pose.y, pose.theta) for pose in TURNING[1:4]])
    values = np.append([math.log(FOCAL / WIDTH) + 0.1, PITCH_RADIANS - 0.05, 0.0, 0.0], motions)
    pairs = [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)]
    for sigma in (6.0, 3.0, 1.0):
        blurred = [np.asarray(cv2.GaussianBlur(one, (0, 0), sigma), np.float32) for one in details]
        found = Alignment(blurred, pairs).solve(values, 20)
        values = found.values
    assert found.correlations.min() > 0.9
    assert WIDTH * math.exp(found.values[LOG_FOCAL]) == pytest.approx(FOCAL, rel=0.02)
    assert math.degrees(found.values[PITCH]) == pytest.approx(33.0, abs=0.6)
    for number, pose in enumerate(TURNING[1:4]):
        x, y, theta = found.values[4 + 3 * number : 7 + 3 * number]
        assert math.hypot(x - pose.x, y - pose.y) < 0.02
        assert theta == pytest.approx(pose.theta, abs=0.01)


@pytest.mark.slow
def test_turns_over_lines_determine_the_camera() -> None:
    camera = camera_by_pixels(pictures(TURNING))
    assert camera is not None
    assert not camera.reason
    assert camera.focal_pixels == pytest.approx(FOCAL, rel=0.02)
    assert math.degrees(camera.pitch_radians) == pytest.approx(33.0, abs=0.5)


@pytest.mark.slow
def test_a_straight_line_over_lines_is_refused() -> None:
    straight = [Pose2(0.12 * number, 0.0, 0.0) for number in range(5)]
    camera = camera_by_pixels(pictures(straight))
    assert camera is None or camera.reason


@pytest.mark.slow
def test_the_simulated_course_without_a_calibration_is_one_map(
    data_folder: Path, tmp_path: Path
) -> None:
    result = slam("stitch", data_folder / "gazebo", "-o", tmp_path / "map")
    assert "heights of the camera" in result.output
    rows = {row["frame"]: row for row in read_rows(tmp_path / "map" / "poses.csv")}
    placed = [name for name, row in rows.items() if row["status"] == "tracked"]
    assert placed == [f"cap{number}.jpg" for number in range(1, 6)]
    assert "640x360" in rows["calibrate.jpg"]["reason"]
    assert rows["cap6.jpg"]["reason"]
    # With the camera calibrated by the square of cap6, and its height as the unit.
    heading, x, y = (float(rows["cap5.jpg"][key]) for key in ("heading", "x", "y"))
    assert math.degrees(heading) == pytest.approx(-36.35, abs=0.5)
    assert x == pytest.approx(-0.336, abs=0.02)
    assert y == pytest.approx(-1.002, abs=0.02)
