"""The mounting: height, pitch and roll of a camera to the homography between floor and picture."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.geometry import invert


def robot_from_camera_rotation(
    pitch_radians: float, roll_radians: float, ahead_radians: float = math.nan
) -> Float64Array:
    """Return the (3, 3) rotation from optical (x right, y down, z ahead) to robot axes.

    Pitch turns about the robot's y axis. Roll turns before it, about the optical axis, which then
    points ahead; or, where a direction in the picture does, after it and about the robot's x axis:
    so both are tilts of a camera that looks straight down, where the first two turn about one axis.
    """
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    cos_pitch, sin_pitch = math.cos(pitch_radians), math.sin(pitch_radians)
    about_y = np.array([[cos_pitch, 0.0, sin_pitch], [0.0, 1.0, 0.0], [-sin_pitch, 0.0, cos_pitch]])
    about_x = _about_x(roll_radians)
    if math.isnan(ahead_radians):
        rotation: Float64Array = about_y @ about_x @ level
    else:
        rotation = about_x @ about_y @ _about_x(-ahead_radians) @ level
    return rotation


def tilt(up: Float64Array, ahead_radians: float = math.nan) -> tuple[float, float]:
    """Return pitch and roll, radians, from the floor's upward unit normal in optical axes."""
    if math.isnan(ahead_radians):
        return math.asin(float(np.clip(-up[2], -1.0, 1.0))), math.atan2(-up[0], -up[1])
    cos_ahead, sin_ahead = math.cos(ahead_radians), math.sin(ahead_radians)
    right = cos_ahead * up[0] + sin_ahead * up[1]
    down = cos_ahead * up[1] - sin_ahead * up[0]
    return math.atan2(-up[2], -down), math.asin(float(np.clip(-right, -1.0, 1.0)))


def _about_x(radians: float) -> Float64Array:
    cosine, sine = math.cos(radians), math.sin(radians)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def image_from_robot_homography(
    camera_matrix: Float64Array,
    height_metres: float,
    pitch_radians: float,
    roll_radians: float,
    ahead_radians: float = math.nan,
) -> Float64Array:
    """Return the (3, 3) homography from floor metres to undistorted pixels.

    The camera's centre is (0, 0, height) in the robot frame, so a floor point (x, y) is seen along
    ``K R^T (x, y, -height)`` (Hartley and Zisserman, Multiple View Geometry, 8.1). The third
    coordinate is the depth along the optical axis: positive in front of the camera.
    """
    rotation = robot_from_camera_rotation(pitch_radians, roll_radians, ahead_radians)
    plane = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -height_metres]])
    homography: Float64Array = camera_matrix @ rotation.T @ plane
    return homography


def compose_robot_from_image(
    camera_matrix: Float64Array,
    height_metres: float,
    pitch_radians: float,
    roll_radians: float,
    ahead_radians: float = math.nan,
) -> Float64Array:
    """Return the (3, 3) homography from undistorted pixels to floor metres."""
    return invert(
        image_from_robot_homography(
            camera_matrix, height_metres, pitch_radians, roll_radians, ahead_radians
        )
    )


def rocked(calibration: Calibration, rocking: Rocking) -> Calibration:
    """Return the calibration of one frame, moved by its pitch, roll and height.

    Of a top-down frame without a calibration pitch and roll turn the camera about the picture's
    horizontal and vertical axis, and the height above the floor that its middle shows is the focal
    length in pixels but for the rocking: see `top_down_homography`. In metres it is that times the
    size of a pixel on the floor.
    """
    if calibration.is_top_down:
        return _rocked_top_down(calibration, rocking)
    height = calibration.height_metres + rocking.height_metres
    pitch = calibration.pitch_radians + rocking.pitch_radians
    roll = calibration.roll_radians + rocking.roll_radians
    return replace(
        calibration,
        height_metres=height,
        pitch_radians=pitch,
        roll_radians=roll,
        robot_from_image=compose_robot_from_image(
            calibration.camera_matrix, height, pitch, roll, calibration.ahead_radians
        ),
    )


def top_down_homography(camera_matrix: Float64Array, rocking: Rocking) -> Float64Array:
    """Return the (3, 3) homography from floor to undistorted pixels of a camera that looks down.

    The robot frame lies on the floor in the picture's middle, x to the picture's right and y up;
    the camera is ``focal length + rocking.height_metres`` away from there along its optical axis.
    Without rocking a pixel is a unit of the floor.
    """
    focal = float(camera_matrix[0, 0])
    cos_pitch, sin_pitch = math.cos(rocking.pitch_radians), math.sin(rocking.pitch_radians)
    cos_roll, sin_roll = math.cos(rocking.roll_radians), math.sin(rocking.roll_radians)
    plane = np.array(
        [
            [cos_roll, -sin_roll * sin_pitch, 0.0],
            [0.0, -cos_pitch, 0.0],
            [-sin_roll, -cos_roll * sin_pitch, focal + rocking.height_metres],
        ]
    )
    homography: Float64Array = camera_matrix @ plane / focal
    return homography


def _rocked_top_down(calibration: Calibration, rocking: Rocking) -> Calibration:
    focal = float(calibration.camera_matrix[0, 0])
    unit_pixels = float(calibration.robot_from_image[0, 0])
    in_pixels = replace(rocking, height_metres=rocking.height_metres / unit_pixels)
    homography = top_down_homography(calibration.camera_matrix, in_pixels)
    range_factor = max(1.0, 1.0 + in_pixels.height_metres / focal)
    return replace(
        calibration,
        robot_from_image=np.diag([unit_pixels, unit_pixels, 1.0]) @ invert(homography),
        max_range_metres=calibration.max_range_metres * range_factor,
    )
