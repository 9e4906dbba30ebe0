"""A camera that looks ahead, calibrated by the motions of the floor alone."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from command_line import slam
from trajectories import read_rows

from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.survey import oblique
from slamcli.survey.oblique import FloorMotion, estimate_camera

SIZE = (640, 480)
FOCAL, PITCH, ROLL = 560.0, math.radians(38.0), math.radians(1.5)


def motions(steps: list[Pose2], noise_pixels: float = 0.1) -> list[FloorMotion]:
    """Return the floor's motions for a camera of height 1."""
    generator = np.random.default_rng(0)
    image_from_floor = image_from_robot_homography(np.diag([FOCAL, FOCAL, 1.0]), 1.0, PITCH, ROLL)
    found = []
    for step in steps:
        floor = generator.uniform((0.5, -1.2), (3.0, 1.2), (300, 2))
        before, after = floor, step.inverse().apply(floor)
        pixels = [apply_homography(image_from_floor, points) for points in (before, after)]
        inside = np.all([np.all(np.abs(p) < np.array(SIZE) / 2, axis=1) for p in pixels], axis=0)
        first, second = (
            p[inside] + generator.normal(0.0, noise_pixels, p[inside].shape) for p in pixels
        )
        found.append(FloorMotion(first, second, apart=False, residual_pixels=noise_pixels))
    return found


def test_turns_determine_the_camera() -> None:
    steps = [Pose2(0.3, 0.05 * number, 0.1 * number - 0.2) for number in range(6)]
    camera = estimate_camera(motions(steps), SIZE)
    assert not camera.reason
    assert camera.focal_pixels == pytest.approx(FOCAL, rel=0.01)
    assert math.degrees(camera.pitch_radians) == pytest.approx(38.0, abs=0.3)
    assert math.degrees(camera.roll_radians) == pytest.approx(1.5, abs=0.3)
    assert camera.median_pixels < 0.3


def test_a_focal_length_beyond_numbers_is_no_camera() -> None:
    (motion,) = motions([Pose2(0.1, 0.0, 0.2)])
    off = oblique._Matches.of([motion], 100).residuals(np.array([-200.0, 1.0, 0.0, 0.0]), 640)
    assert np.abs(off).min() == oblique._BEHIND_PIXELS


def test_a_straight_line_is_refused() -> None:
    camera = estimate_camera(motions([Pose2(0.3, 0.0, 0.0)] * 6, noise_pixels=0.3), SIZE)
    assert "do not determine the focal length" in camera.reason


def test_a_noted_focal_length_makes_a_straight_line_determine_the_pitch() -> None:
    straight = motions([Pose2(0.3, 0.0, 0.0)] * 6)
    camera = estimate_camera(straight, SIZE, focal_pixels=0.99 * FOCAL)
    assert not camera.reason
    assert camera.focal_pixels == pytest.approx(FOCAL, rel=0.03)
    assert math.degrees(camera.pitch_radians) == pytest.approx(38.0, abs=1.0)


def test_too_few_motions_are_refused() -> None:
    assert estimate_camera(motions([Pose2(0.3, 0.0, 0.1)]), SIZE).reason


@pytest.mark.slow
def test_the_real_course_without_a_calibration_is_a_map_of_its_floor(
    data_folder: Path, tmp_path: Path
) -> None:
    result = slam("stitch", data_folder / "course", "-o", tmp_path / "map")
    assert result.exit_code == 0, result.output
    assert "heights of the camera" in result.output
    rows = read_rows(tmp_path / "map" / "poses.csv")
    assert [row["status"] for row in rows] == ["tracked"] * 12
    assert {row["fragment"] for row in rows} == {"0"}
    headings = np.array([float(row["heading"]) for row in rows])
    # As with a calibration by the square of c01, not 0 as of the walls.
    assert headings.max() - headings.min() > 0.5
