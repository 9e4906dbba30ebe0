"""How a wrong calibration changes measured motions, against motions fitted with a wrong one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.camera.projection import project_floor
from slamcli.core.camera.sensitivity import motion_sensitivities
from slamcli.core.geometry import Pose2, apply_homography, pose_array
from slamcli.core.robust import fit_rigid_2d
from slamcli.simulation.config import CameraOptions
from slamcli.simulation.photograph import make_camera

MOTIONS = (Pose2(0.08, 0.0, 0.05), Pose2(0.2, -0.05, -0.3), Pose2(-0.1, 0.1, 0.4), Pose2())


def wrong(calibration: Calibration, error: np.ndarray) -> Calibration:
    """Return a calibration of another log focal length, log height, pitch and roll."""
    zoom = math.exp(error[0])
    matrix = calibration.camera_matrix @ np.diag([zoom, zoom, 1.0])
    mounting = (
        calibration.height_metres * math.exp(error[1]),
        calibration.pitch_radians + error[2],
        calibration.roll_radians + error[3],
    )
    return replace(
        calibration,
        camera_matrix=matrix,
        robot_from_image=compose_robot_from_image(matrix, *mounting),
    )


@pytest.mark.parametrize("parameter", range(4))
def test_a_motion_fitted_with_a_wrong_calibration_is_off_by_as_much(parameter: int) -> None:
    true = make_camera(CameraOptions(roll_degrees=2.0))
    error = np.zeros(4)
    error[parameter] = 1e-4
    found = wrong(true, error)
    expected = motion_sensitivities(true, pose_array(MOTIONS)) @ error
    for motion, change in zip(MOTIONS, expected, strict=True):
        in_b = seen_floor(true)
        in_b = in_b[project_floor(true, motion.apply(in_b))[1]]
        pixels = [
            apply_homography(true.image_from_robot, points) for points in (motion.apply(in_b), in_b)
        ]
        measured = fit_rigid_2d(*(apply_homography(found.robot_from_image, p) for p in pixels))
        off = motion.inverse() @ measured
        # Of a few points of the same floor.
        tolerance = 0.2 * float(np.abs(change).max()) + 1e-9
        assert off.x == pytest.approx(change[0], abs=tolerance)
        assert off.y == pytest.approx(change[1], abs=tolerance)
        assert off.theta == pytest.approx(change[2], abs=tolerance)


def test_a_camera_that_is_higher_makes_all_lengths_longer_and_no_angle() -> None:
    calibration = make_camera(CameraOptions())
    by_height = motion_sensitivities(calibration, pose_array(MOTIONS))[:, :, 1]
    for motion, change in zip(MOTIONS, by_height, strict=True):
        turn_back = Pose2(0.0, 0.0, -motion.theta)
        along = turn_back.apply([(motion.x, motion.y)])[0]
        assert change == pytest.approx([*along, 0.0], abs=1e-6)


def test_frames_without_floor_in_common_have_no_error_to_share() -> None:
    calibration = make_camera(CameraOptions())
    assert not motion_sensitivities(calibration, np.array([[50.0, 0.0, 0.0]])).any()
    assert motion_sensitivities(calibration, np.empty((0, 3))).shape == (0, 3, 4)
