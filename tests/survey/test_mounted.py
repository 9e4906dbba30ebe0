"""Surveys of a calibrated camera that is carried by hand: poses of the robot, tilt and height."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from flights import floor_picture

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.lens import distort_points, image_centre
from slamcli.core.camera.mounting import rocked
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.simulation.config import CameraOptions
from slamcli.simulation.photograph import make_camera
from slamcli.survey import SurveyFeatures, survey
from slamcli.survey.features import local_detail
from slamcli.survey.ideal_picture import ideal_picture
from slamcli.survey.mounted import calibrated_lens, mounted

FRAMES, STEP_METRES, TURN_RADIANS, NOISE_PIXELS = 12, 0.06, 0.25, 0.2
FLOOR_METRES = 3.0


def camera(pitch_degrees: float) -> Calibration:
    return make_camera(CameraOptions((320, 240), pitch_degrees=pitch_degrees))


def path() -> list[Pose2]:
    poses = [Pose2()]
    while len(poses) < FRAMES:
        poses.append(poses[-1] @ Pose2(STEP_METRES, 0.0, TURN_RADIANS))
    return poses


def rockings(generator: np.random.Generator) -> list[Rocking]:
    tilts = np.radians(3.0) * generator.standard_normal((FRAMES, 2))
    heights = 0.02 * generator.standard_normal(FRAMES)
    return [
        Rocking(float(pitch), float(roll), float(height))
        for (pitch, roll), height in zip(tilts, heights - heights.mean(), strict=True)
    ]


def described(
    calibration: Calibration, poses: list[Pose2], rocking: list[Rocking]
) -> list[SurveyFeatures]:
    """Return what frames show of points with descriptors of their own, and of a floor's picture."""
    generator = np.random.default_rng(3)
    points = generator.uniform(-FLOOR_METRES / 2, FLOOR_METRES / 2, (12_000, 2))
    descriptors = generator.standard_normal((len(points), 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    floor = cv2.resize(floor_picture(), (900, 900))
    pixels_from_floor = np.array([[300.0, 0.0, 450.0], [0.0, -300.0, 450.0], [0.0, 0.0, 1.0]])
    size = calibration.image_size
    found = []
    for pose, tilt in zip(poses, rocking, strict=True):
        image_from_map = rocked(calibration, tilt).image_from_robot @ pose.inverse().matrix
        seen = apply_homography(image_from_map, points)
        depth = points @ image_from_map[2, :2] + image_from_map[2, 2]
        inside = (depth > 0.0) & (depth < 1.5) & np.all((seen >= 0) & (seen < size), axis=1)
        pixels = seen[inside] - image_centre(size)
        pixels += NOISE_PIXELS * generator.standard_normal(pixels.shape)
        picture = cv2.warpPerspective(floor, image_from_map @ invert(pixels_from_floor), size)
        thumbnail = local_detail(np.asarray(picture, np.uint8), None, 160)
        coarse = np.arange(min(300, len(pixels)))
        found.append(SurveyFeatures(size, pixels, descriptors[inside], coarse, thumbnail))
    return found


@pytest.mark.parametrize(("pitch", "degrees"), [(38.0, 0.1), (90.0, 0.3)])
def test_a_camera_carried_by_hand_is_placed_with_its_tilt_and_height(
    pitch: float, degrees: float
) -> None:
    calibration, poses = camera(pitch), path()
    rocking = rockings(np.random.default_rng(1))
    found = survey(described(calibration, poses, rocking), calibrated_lens(calibration))
    assert [len(one.frames) for one in found.maps] == [FRAMES]
    frames = [mounted(state, calibration) for state in found.maps[0].bundle.states]
    unit = calibration.height_metres / np.mean([frame.height for frame in frames])
    first = frames[0].scaled(unit).map_from_robot.inverse()
    for frame, pose, tilt in zip(frames, poses, rocking, strict=True):
        placed = frame.scaled(unit)
        error = (poses[0].inverse() @ pose).inverse() @ first @ placed.map_from_robot
        tilted_metres = calibration.height_metres * math.radians(degrees)
        assert error.translation_length < 2.0 * tilted_metres
        assert abs(error.theta) < math.radians(0.1)
        own = placed.rocking(calibration)
        assert own.pitch_radians == pytest.approx(tilt.pitch_radians, abs=math.radians(degrees))
        assert own.roll_radians == pytest.approx(tilt.roll_radians, abs=math.radians(degrees))
        assert own.height_metres == pytest.approx(tilt.height_metres, abs=0.001)


def test_an_ideal_picture_has_no_distortion_and_its_principal_point_in_the_middle() -> None:
    options = CameraOptions((320, 240), k1=-0.2)
    calibration = make_camera(options)
    straight = make_camera(CameraOptions((320, 240)))
    points: Float64Array = np.array([[0.4, 0.1], [0.5, -0.15], [0.7, 0.05]])
    image = np.zeros((240, 320), np.uint8)
    # A smooth picture: each pixel's column, as the camera's lens shifts it.
    image[:] = np.arange(320, dtype=np.uint8) // 2
    ideal, usable = ideal_picture(calibration).of(image, None)
    for column, row in apply_homography(straight.image_from_robot, points).tolist():
        own = distort_points(calibration, [[column, row]])[0]
        assert usable[round(row), round(column)] == 255
        assert ideal[round(row), round(column)] == pytest.approx(own[0] / 2.0, abs=1.5)
