"""The mounting: tilts, and the direction in the picture that points ahead."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.camera.mounting import robot_from_camera_rotation, tilt

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("pitch", [-10.0, 30.0, 70.0, 89.0, 90.0, 110.0])
@pytest.mark.parametrize("roll", [-3.0, 0.0, 20.0])
@pytest.mark.parametrize("ahead", [math.nan, 0.0, 90.0, -135.0, 180.0])
def test_the_tilt_follows_from_the_floors_normal(pitch: float, roll: float, ahead: float) -> None:
    if math.isnan(ahead):
        # Steeper, the optical axis does not point ahead.
        pitch = min(pitch, 85.0)
    angles = np.radians([pitch, roll, ahead])
    rotation = robot_from_camera_rotation(*angles)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert tilt(rotation.T @ UP, angles[2]) == pytest.approx(tuple(angles[:2]), abs=1e-9)


@pytest.mark.parametrize("ahead", [0.0, 30.0, 90.0, -90.0, 180.0])
def test_looking_straight_down_that_direction_of_the_picture_is_ahead(ahead: float) -> None:
    rotation = robot_from_camera_rotation(math.pi / 2, 0.0, math.radians(ahead))
    direction = np.array([math.sin(math.radians(ahead)), -math.cos(math.radians(ahead)), 0.0])
    assert np.allclose(rotation @ direction, [1.0, 0.0, 0.0])


def test_without_roll_both_conventions_are_one() -> None:
    for pitch in (0.3, 1.2, 1.5):
        axis = robot_from_camera_rotation(pitch, 0.0)
        assert np.allclose(axis, robot_from_camera_rotation(pitch, 0.0, 0.0))


def test_a_positive_roll_lowers_the_right_side() -> None:
    for ahead in (math.nan, 0.0):
        right = robot_from_camera_rotation(0.5, 0.1, ahead) @ [1.0, 0.0, 0.0]
        assert right[2] < 0
