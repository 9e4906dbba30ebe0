"""The calibration's errors in the poses' covariances, against maps made with wrong calibrations."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from square_photos import Photo, render

from slamcli.core.camera.sensitivity import motion_sensitivities
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.records import Link, PoseEstimate
from slamcli.mapping.backend.calibration_error import with_calibration_error
from slamcli.mapping.backend.pose_graph import PoseGraph
from slamcli.mapping.backend.sensors import Sensors
from slamcli.run.calibrate import CalibrateOptions, find_target
from slamcli.simulation.config import CameraOptions
from slamcli.simulation.photograph import make_camera
from slamcli.stages import calibrate, posegraph

FRAMES = 24
STEP = Pose2(0.2, 0.0, math.tau / FRAMES)
LINK_COVARIANCE = np.diag([1e-4, 1e-4, 1e-4]) ** 2
# What a square leaves open: heights and focal lengths that make up for one another, and tilts.
COVARIANCE = np.diag([2e-3, 2e-3, 5e-4, 1e-3]) ** 2
COVARIANCE[0, 1] = COVARIANCE[1, 0] = 0.95 * 2e-3**2
CALIBRATION = replace(make_camera(CameraOptions()), covariance=COVARIANCE)


def drive(error: np.ndarray, *, closed: bool) -> PoseGraph:
    """Return the solved graph of a circle, its links measured with a wrong calibration."""
    true = [Pose2()]
    for _ in range(FRAMES - 1):
        true.append(true[-1] @ STEP)
    pairs = [(i, i + 1) for i in range(FRAMES - 1)] + ([(FRAMES - 1, 0)] if closed else [])
    motions = [true[a].inverse() @ true[b] for a, b in pairs]
    changes = motion_sensitivities(CALIBRATION, pose_array(motions)) @ error
    links = [
        Link(a, b, motion @ Pose2(*change), LINK_COVARIANCE, 99, 1.0, "step")
        for (a, b), motion, change in zip(pairs, motions, changes.tolist(), strict=True)
    ]
    solution = posegraph.solve(dict(enumerate(true)), links)
    graph = PoseGraph()
    graph.add_links(links)
    for i, pose in solution.poses.items():
        covariance = solution.covariances[i]
        graph.set_estimate(PoseEstimate(i, f"{i}", None, pose, "tracked", "", 0, covariance))
    return graph


@pytest.mark.parametrize("closed", [False, True])
def test_poses_are_as_far_off_as_a_wrong_calibration_puts_them(closed: bool) -> None:
    error = np.array([2e-3, 1.5e-3, -5e-4, 1e-3])
    right, moved = drive(np.zeros(4), closed=closed), drive(error, closed=closed)
    certain = replace(CALIBRATION, covariance=np.outer(error, error))
    for known, estimate in zip(
        right.estimates, with_calibration_error(right, Sensors(), certain), strict=True
    ):
        off = right.pose(known.index).inverse() @ moved.pose(known.index)
        vector = np.array([off.x, off.y, off.theta])
        added = estimate.covariance - known.covariance
        scale = float(vector @ vector) + 1e-11
        assert added == pytest.approx(np.outer(vector, vector), rel=0.02, abs=0.02 * scale)
    # One turn of a map that is curved too much or too little: the ends of a chain part.
    assert math.hypot(off.x, off.y) > (0.0 if closed else 0.002)


def test_the_covariances_match_the_errors_of_many_calibrations() -> None:
    right = drive(np.zeros(4), closed=True)
    middle = FRAMES // 2
    estimate = with_calibration_error(right, Sensors(), CALIBRATION)[middle]
    added = (estimate.covariance - right[middle].covariance)[:2, :2]
    # Poses are linear in so small errors: one map for each number tells those of all others.
    units = 1e-3 * np.eye(4)
    moved = [right.pose(middle).inverse() @ drive(u, closed=True).pose(middle) for u in units]
    by_error = 1e3 * pose_array(moved)[:, :2].T
    errors = np.random.default_rng(5).multivariate_normal(np.zeros(4), COVARIANCE, 1000)
    vectors = errors @ by_error.T
    normalised = np.einsum("ni,ij,nj->n", vectors, np.linalg.inv(added), vectors)
    # 95 % of means of 1000 values of two degrees of freedom lie so.
    assert 1.88 < np.mean(normalised) < 2.12


def test_without_a_covariance_nothing_is_added() -> None:
    graph = drive(np.zeros(4), closed=True)
    unknown = replace(CALIBRATION, covariance=None)
    assert with_calibration_error(graph, Sensors(), unknown) == graph.estimates


def test_the_covariance_of_a_calibration_matches_its_errors_with_noisy_corners() -> None:
    photo = Photo(yaw=25.0, roll=2.0)
    generator = np.random.default_rng(4)
    normalised = []
    for _ in range(40):
        noisy = photo.corners + generator.normal(scale=0.2, size=(4, 2))
        ordered = calibrate.sort_corners(noisy, photo.size)
        points = calibrate.FloorPoints(
            calibrate.square_target(photo.side), ordered, np.eye(8) * 0.2**2
        )
        mounting = calibrate.solve_mounting(points, photo.size)
        found = calibrate.make_calibration(mounting, photo.size, None, None)
        error = np.array(
            [
                math.log(found.camera_matrix[0, 0] / photo.focal),
                math.log(found.height_metres / photo.height),
                found.pitch_radians - math.radians(photo.pitch),
                found.roll_radians - math.radians(photo.roll),
            ]
        )
        normalised.append(error @ np.linalg.solve(found.covariance, error))
    # 95 % of means of 40 values of four degrees of freedom lie so.
    assert 3.17 < np.mean(normalised) < 4.93


def test_the_scale_of_squares_in_light_is_within_its_sigma() -> None:
    scores = []
    for seed in range(2):
        photo = Photo(seed, yaw=10.0 + 15.0 * seed, blur=0.7, noise=2.0)
        target = find_target(render(photo), CalibrateOptions(photo.side), None)
        mounting = calibrate.solve_mounting(target.points, photo.size)
        found = calibrate.make_calibration(mounting, photo.size, None, None)
        # A step straight ahead, measured with it.
        step = 0.1
        by_parameter = motion_sensitivities(found, np.array([[step, 0.0, 0.0]]))[0, 0]
        error = by_parameter @ np.array(
            [
                math.log(found.camera_matrix[0, 0] / photo.focal),
                math.log(found.height_metres / photo.height),
                found.pitch_radians - math.radians(photo.pitch),
                found.roll_radians - math.radians(photo.roll),
            ]
        )
        assert abs(error) < 0.001 * step
        scores.append(error / math.sqrt(by_parameter @ found.covariance @ by_parameter))
    assert np.sqrt(np.mean(np.square(scores))) < 1.5
