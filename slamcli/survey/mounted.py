"""The states of a survey as poses of a robot, where the camera's calibration is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Intrinsics, Rocking
from slamcli.core.camera.mounting import compose_robot_from_image, robot_from_camera_rotation, tilt
from slamcli.core.geometry import Pose2
from slamcli.survey.ideal_picture import (
    camera_from_nadir,
    camera_from_nadir_rotation,
    focal_pixels,
)
from slamcli.survey.lens import Lens, LensPrior
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL, STATES, YAW, X, Y

_DIFFERENCE = 1e-6


@dataclass(frozen=True, slots=True)
class MountedFrame:
    """A frame of a calibrated camera in the map.

    Attributes
    ----------
    map_from_robot : Pose2
        The robot's origin lies on the floor straight below the camera; units of the map.
    height : float
        Of the camera, units of the map.
    pitch_radians, roll_radians : float
        As in `Calibration`.
    """

    map_from_robot: Pose2
    height: float
    pitch_radians: float
    roll_radians: float

    def rocking(self, calibration: Calibration) -> Rocking:
        """Return the difference to the calibration."""
        return Rocking(
            self.pitch_radians - calibration.pitch_radians,
            self.roll_radians - calibration.roll_radians,
            self.height - calibration.height_metres,
        )

    def scaled(self, factor: float) -> MountedFrame:
        """Return the frame of a map whose lengths are multiplied."""
        pose = self.map_from_robot
        moved = Pose2(factor * pose.x, factor * pose.y, pose.theta)
        return MountedFrame(moved, factor * self.height, self.pitch_radians, self.roll_radians)

    def robot_from_pixels(self, calibration: Calibration) -> Float64Array:
        """Return the (3, 3) homography to the floor from pixels of an ideal picture's middle."""
        focal = focal_pixels(calibration)
        return compose_robot_from_image(
            np.diag([focal, focal, 1.0]),
            self.height,
            self.pitch_radians,
            self.roll_radians,
            calibration.ahead_radians,
        )


def known_lens(lens: Calibration | Intrinsics) -> Lens:
    """Return the lens of a known camera's ideal pictures, looking down."""
    focal, radius = focal_pixels(lens), 0.5 * math.hypot(*lens.image_size)
    return Lens(focal, 0.0, radius, LensPrior(math.log(focal), 0.0, 0.0))


def calibrated_lens(calibration: Calibration) -> Lens:
    """Return the lens of a calibrated camera's ideal pictures, looking where it does."""
    return replace(known_lens(calibration), camera_from_nadir=camera_from_nadir(calibration))


def mounted(state: Float64Array, calibration: Calibration) -> MountedFrame:
    """Return the frame of a (6,) state."""
    yaw, pitch, roll = state[YAW], state[PITCH], state[ROLL]
    cos_pitch, sin_pitch = math.cos(pitch), math.sin(pitch)
    cos_roll, sin_roll = math.cos(roll), math.sin(roll)
    # The axes of the robot, of a camera that looks down with the state's tilt: see `project`.
    x_axis = np.array([cos_roll, 0.0, -sin_roll])
    y_axis = np.array([-sin_roll * sin_pitch, -cos_pitch, -cos_roll * sin_pitch])
    nadir_from_level = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    away = focal_pixels(calibration) * math.exp(state[LOG_SCALE])
    below = away * np.array([sin_roll, cos_roll * sin_pitch])
    turn = Pose2(0.0, 0.0, float(yaw))
    level_from_map = np.eye(3)
    level_from_map[:2, :2] = turn.inverse().matrix[:2, :2]
    camera_from_map = camera_from_nadir_rotation(calibration) @ nadir_from_level @ level_from_map
    own_pitch, own_roll = tilt(camera_from_map[:, 2], calibration.ahead_radians)
    robot_from_map = (
        robot_from_camera_rotation(own_pitch, own_roll, calibration.ahead_radians) @ camera_from_map
    )
    heading = math.atan2(robot_from_map[0, 1], robot_from_map[0, 0])
    there = turn.apply(below[None])[0] + state[[X, Y]]
    return MountedFrame(
        Pose2(float(there[0]), float(there[1]), heading),
        away * cos_roll * cos_pitch,
        own_pitch,
        own_roll,
    )


def pose_by_state(state: Float64Array, calibration: Calibration) -> Float64Array:
    """Return the (3, 6) derivatives of x, y and heading by a state, by differences."""
    columns = []
    for number in range(STATES):
        step = np.zeros(STATES)
        step[number] = _DIFFERENCE
        after, before = (
            mounted(state + sign * step, calibration).map_from_robot for sign in (1.0, -1.0)
        )
        turn = math.remainder(after.theta - before.theta, math.tau)
        change = np.array([after.x - before.x, after.y - before.y, turn])
        columns.append(change / (2.0 * _DIFFERENCE))
    return np.stack(columns, axis=1)
