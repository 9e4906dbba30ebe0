"""Poses and mountings of frames that one camera took."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.mounting import robot_from_camera_rotation
from slamcli.core.geometry import Pose2, pose_array


@dataclass(frozen=True, slots=True, eq=False)
class FramePose:
    """Pose of one frame, and its rocking.

    Attributes
    ----------
    map_from_robot : Pose2
    rocking : Rocking
        Its pitch, roll and height beside the calibration.
    """

    map_from_robot: Pose2
    rocking: Rocking


@dataclass(frozen=True, slots=True, eq=False)
class MountedFrames:
    """Poses and mountings of many frames at once; an array's last axis counts the frames.

    Attributes
    ----------
    poses : (N, 3) float64
        ``map_from_robot``: x, y (m) and theta (rad).
    rotations : (3, 3, N) float64
        From optical to robot axes.
    axes : (2, 3, N) float64
        The axes in the robot frame about which pitch and roll turn.
    heights : (N,) float64
        Of the cameras above the floor, metres.
    """

    poses: Float64Array
    rotations: Float64Array
    axes: Float64Array
    heights: Float64Array

    @classmethod
    def of(cls, calibration: Calibration, frames: Sequence[FramePose]) -> MountedFrames:
        """Return frames of one camera."""
        tilts = [
            (
                calibration.pitch_radians + frame.rocking.pitch_radians,
                calibration.roll_radians + frame.rocking.roll_radians,
            )
            for frame in frames
        ]
        ahead = calibration.ahead_radians
        heights = [frame.rocking.height_metres for frame in frames]
        return cls(
            pose_array([frame.map_from_robot for frame in frames]),
            np.stack([robot_from_camera_rotation(*tilt, ahead) for tilt in tilts], axis=-1),
            np.stack([_tilt_axes(calibration, *tilt) for tilt in tilts], axis=-1),
            calibration.height_metres + np.array(heights),
        )

    def take(self, numbers: Int64Array) -> MountedFrames:
        """Return some of the frames, in the order of their numbers."""
        return MountedFrames(
            self.poses[numbers],
            self.rotations[..., numbers],
            self.axes[..., numbers],
            self.heights[numbers],
        )


def _tilt_axes(calibration: Calibration, pitch: float, roll: float) -> Float64Array:
    """Return (2, 3): the axes in the robot frame about which pitch and roll turn.

    Pitch turns about the robot's y, after roll has turned about the optical axis; or before roll
    turns about the robot's x, where a direction in the picture points ahead.
    """
    if math.isnan(calibration.ahead_radians):
        return np.array([[0.0, 1.0, 0.0], [math.cos(pitch), 0.0, -math.sin(pitch)]])
    return np.array([[0.0, math.cos(roll), math.sin(roll)], [1.0, 0.0, 0.0]])
