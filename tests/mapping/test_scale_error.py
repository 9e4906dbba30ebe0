"""The calibration's error of scale is in the poses' covariances, and is as large as it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from square_photos import Photo, render

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.geometry import Pose2, apply_homography, covariance_in_map
from slamcli.core.records import PoseEstimate
from slamcli.mapping.scale_error import with_scale_error
from slamcli.run.calibrate import CalibrateOptions, find_target
from slamcli.stages import calibrate


def estimate(index: int, pose: Pose2 | None, fragment: int = 0) -> PoseEstimate:
    covariance = None if pose is None else np.diag([1e-6, 4e-6, 1e-6])
    return PoseEstimate(index, f"{index}.jpg", None, pose, "tracked", "", fragment, covariance)


def test_a_pose_is_as_uncertain_as_its_distance_from_the_start_times_the_scales_sigma() -> None:
    here = Pose2(3.0, 4.0, math.radians(30.0))
    first, lost, moved, other = with_scale_error(
        [estimate(0, Pose2()), estimate(1, None), estimate(2, here), estimate(3, here, 1)], 0.001
    )
    assert np.array_equal(first.covariance, np.diag([1e-6, 4e-6, 1e-6]))
    assert lost.covariance is None
    assert np.array_equal(other.covariance, first.covariance)
    added = covariance_in_map(here, moved.covariance - first.covariance)
    expected = 1e-6 * np.outer([3.0, 4.0, 0.0], [3.0, 4.0, 0.0])
    assert added == pytest.approx(expected, abs=1e-15)


def test_without_a_sigma_nothing_is_added() -> None:
    known = [estimate(0, Pose2()), estimate(1, Pose2(5.0, 0.0, 0.0))]
    assert with_scale_error(known, math.nan) == known


def scale_error(true: Photo, found: Calibration) -> float:
    floor = seen_floor(found)
    pixels = apply_homography(found.image_from_robot, floor)
    real = apply_homography(np.linalg.inv(true.image_from_robot), pixels)
    spread = [np.sqrt(np.mean(np.var(points, axis=0))) for points in (floor, real)]
    return float(spread[0] / spread[1] - 1.0)


def test_the_scales_sigma_matches_the_scales_of_calibrations_with_noisy_corners() -> None:
    photo = Photo(yaw=25.0, roll=2.0)
    generator = np.random.default_rng(4)
    scores = []
    for _ in range(40):
        noisy = photo.corners + generator.normal(scale=0.2, size=(4, 2))
        ordered = calibrate.sort_corners(noisy, photo.size)
        points = calibrate.FloorPoints(
            calibrate.square_target(photo.side), ordered, np.eye(8) * 0.2**2
        )
        mounting = calibrate.solve_mounting(points, photo.size)
        found = calibrate.make_calibration(mounting, photo.size, None, None)
        scores.append(scale_error(photo, found) / found.scale_sigma)
        height_share = found.height_sigma_metres / found.height_metres
        assert found.scale_sigma < height_share
    assert 0.65 < np.sqrt(np.mean(np.square(scores))) < 1.35


def test_the_scale_of_squares_in_light_is_within_its_sigma() -> None:
    scores = []
    for seed in range(4):
        photo = Photo(seed, yaw=10.0 + 15.0 * seed, blur=0.7, noise=2.0)
        target = find_target(render(photo), CalibrateOptions(photo.side), None)
        mounting = calibrate.solve_mounting(target.points, photo.size)
        found = calibrate.make_calibration(mounting, photo.size, None, None)
        assert abs(scale_error(photo, found)) < 0.001
        scores.append(scale_error(photo, found) / found.scale_sigma)
    assert np.sqrt(np.mean(np.square(scores))) < 1.5
