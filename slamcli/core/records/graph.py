"""Nodes and edges of the pose graph, and the map of a finished drive."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.config import Datum, FeatureOptions, FrameSelection
from slamcli.core.geometry import Pose2
from slamcli.core.records.frames import Keyframe

LinkKind = Literal["step", "loop", "odometry", "compass", "gps", "partial"]
Status = Literal["tracked", "predicted", "lost"]


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """An edge of the pose graph: a measured motion between two frames.

    Attributes
    ----------
    a, b : int
        Frame indices.
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m) and theta (rad), in b's own axes (GTSAM's tangent space).
    inliers : int
    score : float
        Probability that the motion is right, in [0, 1]; nan when it is not from pictures.
    kind : str
    """

    a: int
    b: int
    a_from_b: Pose2
    covariance: Float64Array
    inliers: int
    score: float
    kind: LinkKind


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """A node of the pose graph: the robot's pose at one frame, or why it is unknown.

    Attributes
    ----------
    index, name, stamp
        Of the frame.
    map_from_robot : Pose2 or None
        None when lost.
    status : str
    reason : str
        Why the frame is not tracked, or a remark; mostly empty when it is.
    fragment : int
        Which connected map the pose belongs to; -1 when lost.
    covariance : (3, 3) float64 or None
        Of x, y (m), theta (rad), in the robot's own axes.
    inliers : int
    score : float
        Highest of the links that the pose was inserted by; nan without one.
    revised : tuple of int
        Frames whose earlier estimates this update changed.
    odom_from_robot : Pose2 or None
        The sum of all frames' motions so far: it drifts and never jumps (ROS REP 105), for a
        controller, while `map_from_robot` may be revised. None when lost.
    rocking : Rocking or None
        The camera's deviation from the calibration; None for none.
    """

    index: int
    name: str
    stamp: float | None
    map_from_robot: Pose2 | None
    status: Status
    reason: str = ""
    fragment: int = -1
    covariance: Float64Array | None = None
    inliers: int = 0
    score: float = float("nan")
    revised: tuple[int, ...] = field(default=())
    odom_from_robot: Pose2 | None = None
    rocking: Rocking | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FloorMap:
    """The map of a finished drive, to localise in and to extend.

    Attributes
    ----------
    calibration : Calibration
        Of the camera that made it.
    features : FeatureOptions
        How its points were detected; those of a frame to be localised are detected alike.
    metres_per_pixel : float
        Of the views.
    tilt_sigma_degrees : float
        One standard deviation of the camera's pitch from frame to frame.
    keyframes : tuple of Keyframe
        Those with a pose.
    estimates : tuple of PoseEstimate
        One for every frame, in order.
    links : tuple of Link
        Between them, those of odometry included.
    sources : tuple of Path
        Folders and files that the frames were read from, in their order; empty where not recorded.
    selection : FrameSelection
        Which frames were taken of those that are videos or bags.
    datums : tuple of (int, Datum)
        Fragments whose place on Earth was measured, and that of their origins.
    """

    calibration: Calibration
    features: FeatureOptions
    metres_per_pixel: float
    tilt_sigma_degrees: float
    keyframes: tuple[Keyframe, ...]
    estimates: tuple[PoseEstimate, ...]
    links: tuple[Link, ...]
    sources: tuple[Path, ...] = ()
    selection: FrameSelection = field(default_factory=FrameSelection)
    datums: tuple[tuple[int, Datum], ...] = ()
