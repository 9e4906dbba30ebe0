"""Transfer of a pixel from one frame to another over the plane, with analytic derivatives.

As the floor is a plane, no landmark positions are unknown: lens, ray, floor, motion, and the same
back (Hartley and Zisserman, Multiple View Geometry, 8.1). OpenCV differentiates the lens models;
the rest is written out here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.calibration import Calibration, Rocking
from slamcli.core.camera.lens import distort_points, undistort_points
from slamcli.core.camera.mounting import (
    compose_robot_from_image,
    robot_from_camera_rotation,
    rocked,
)
from slamcli.core.geometry import Pose2, apply_homography, invert

# Numbers of parameters, in the order of the Jacobians' columns: of the camera; of a frame, of which
# the first are its pose.
CAMERA_PARAMETERS = 7
FRAME_PARAMETERS = 6
POSE_PARAMETERS = 3


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
class Transfer:
    """Pixels of frame a transferred to frame b.

    Attributes
    ----------
    pixels : (N, 2) float64
        In b's own image; nan behind a camera.
    by_camera : (N, 2, 7) float64
        By log focal length, the first two radial coefficients, pitch and roll (rad), and the
        principal point's column and row (in focal lengths).
    by_a, by_b : (N, 2, 6) float64
        By either frame's x, y (m) and theta (rad), in its own axes, and by its own pitch, roll
        (rad) and log height.
    """

    pixels: Float64Array
    by_camera: Float64Array
    by_a: Float64Array
    by_b: Float64Array


def changed(calibration: Calibration, change: Float64Array) -> Calibration:
    """Return a calibration with the seven parameters of `Transfer` changed; its height stays."""
    zoom = math.exp(float(change[0]))
    matrix = calibration.camera_matrix @ np.diag([zoom, zoom, 1.0])
    matrix[:, 2] = calibration.camera_matrix[:, 2]
    matrix[:2, 2] += change[5:7] * calibration.camera_matrix[[0, 1], [0, 1]]
    distortion = calibration.distortion.copy()
    distortion[:2] += change[1:3]
    pitch = calibration.pitch_radians + float(change[3])
    roll = calibration.roll_radians + float(change[4])
    return replace(
        calibration,
        camera_matrix=matrix,
        distortion=distortion,
        pitch_radians=pitch,
        roll_radians=roll,
        robot_from_image=compose_robot_from_image(
            matrix, calibration.height_metres, pitch, roll, calibration.ahead_radians
        ),
    )


def transfer(
    calibration: Calibration, a: FramePose, b: FramePose, pixels_a: Float64Array
) -> Float64Array:
    """Return (N, 2): where b sees the floor that a sees at (N, 2) pixels; nan where it does not."""
    there_from_here = (
        rocked(calibration, b.rocking).image_from_robot
        @ (b.map_from_robot.inverse() @ a.map_from_robot).matrix
    )
    here = rocked(calibration, a.rocking).robot_from_image
    undistorted = undistort_points(calibration, pixels_a)
    homogeneous = np.column_stack([undistorted, np.ones(len(undistorted))]) @ here.T
    seen = homogeneous[:, 2] > 0.0
    depth = homogeneous / np.where(seen, homogeneous[:, 2], 1.0)[:, None] @ there_from_here[2]
    seen &= depth > 0.0
    pixels = np.full_like(undistorted, np.nan)
    pixels[seen] = distort_points(
        calibration, apply_homography(there_from_here @ here, undistorted[seen])
    )
    return pixels


def transfer_with_jacobians(
    calibration: Calibration, a: FramePose, b: FramePose, pixels_a: Float64Array
) -> Transfer:
    """Return where b sees the floor that a sees at (N, 2) pixels, and its derivatives."""
    count = len(pixels_a)
    undistorted = undistort_points(calibration, pixels_a)
    rays = apply_homography(invert(calibration.camera_matrix), undistorted)
    seen_a = _lens(calibration, rays)
    # The lens inverted: what moves the pixel moves the ray the other way.
    ray_by_pixel = np.linalg.inv(seen_a.by_ray)
    ray_by_lens = -ray_by_pixel @ seen_a.by_lens
    floor = _to_floor(calibration, a.rocking, rays)
    b_from_a = b.map_from_robot.inverse() @ a.map_from_robot
    turn = b_from_a.matrix[:2, :2]
    there = b_from_a.apply(floor.points)
    back = _to_ray(calibration, b.rocking, there)
    seen_b = _lens(calibration, back.rays)
    pixels = np.where(floor.seen[:, None] & back.seen[:, None], seen_b.pixels, np.nan)

    pixel_by_there = seen_b.by_ray @ back.by_points
    pixel_by_floor = pixel_by_there @ turn
    by_mounting_a = pixel_by_floor @ floor.by_mounting
    by_mounting_b = seen_b.by_ray @ back.by_mounting
    by_camera = np.empty((count, 2, CAMERA_PARAMETERS))
    by_lens = seen_b.by_lens + pixel_by_floor @ floor.by_rays @ ray_by_lens
    by_camera[:, :, :3], by_camera[:, :, 5:] = by_lens[:, :, :3], by_lens[:, :, 3:]
    by_camera[:, :, 3:5] = by_mounting_a[:, :, :2] + by_mounting_b[:, :, :2]
    by_a = np.empty((count, 2, FRAME_PARAMETERS))
    by_a[:, :, :3] = pixel_by_floor @ _by_motion(floor.points)
    by_a[:, :, 3:] = by_mounting_a
    by_b = np.empty((count, 2, FRAME_PARAMETERS))
    by_b[:, :, :3] = -pixel_by_there @ _by_motion(there)
    by_b[:, :, 3:] = by_mounting_b
    return Transfer(pixels, by_camera, by_a, by_b)


@dataclass(frozen=True, slots=True, eq=False)
class _LensPixels:
    """Rays through the lens: pixels (N, 2), by ray (N, 2, 2), by the lens (N, 2, 5).

    That is by log focal length, two radial coefficients, and the principal point.
    """

    pixels: Float64Array
    by_ray: Float64Array
    by_lens: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _FloorPoints:
    """Rays on the floor, robot frame (N, 2), by ray (N, 2, 2), by pitch, roll, log height."""

    points: Float64Array
    seen: BoolArray
    by_rays: Float64Array
    by_mounting: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _FloorRays:
    """Floor points as rays (N, 2), by point (N, 2, 2), by pitch, roll, log height (N, 2, 3)."""

    rays: Float64Array
    seen: BoolArray
    by_points: Float64Array
    by_mounting: Float64Array


def _lens(calibration: Calibration, rays: Float64Array) -> _LensPixels:
    matrix, distortion = calibration.camera_matrix, calibration.distortion
    still = np.zeros(3)
    points = np.column_stack([np.where(np.isfinite(rays), rays, 0.0), np.ones(len(rays))])
    if calibration.distortion_model == "equidistant":
        projected, jacobian = cv2.fisheye.projectPoints(
            points[:, None], still, still, matrix, distortion[:4]
        )
        # Columns: focal lengths, centre, coefficients, rotation, translation, skew.
        focal, centre, radial, shift = slice(0, 2), slice(2, 4), slice(4, 6), slice(11, 13)
    else:
        projected, jacobian = cv2.projectPoints(points, still, still, matrix, distortion)
        # Columns: rotation, translation, focal lengths, centre, coefficients.
        focal, centre, radial, shift = slice(6, 8), slice(8, 10), slice(10, 12), slice(3, 5)
    columns = np.asarray(jacobian, np.float64).reshape(len(rays), 2, -1)
    by_zoom = columns[:, :, focal] @ (matrix[0, 0], matrix[1, 1])
    by_centre = columns[:, :, centre] * (matrix[0, 0], matrix[1, 1])
    by_lens = np.concatenate([by_zoom[:, :, None], columns[:, :, radial], by_centre], axis=2)
    pixels = np.asarray(projected, np.float64).reshape(-1, 2)
    return _LensPixels(pixels, columns[:, :, shift], by_lens)


def _mounting(calibration: Calibration, rocking: Rocking) -> tuple[float, float, float]:
    return (
        calibration.pitch_radians + rocking.pitch_radians,
        calibration.roll_radians + rocking.roll_radians,
        calibration.height_metres + rocking.height_metres,
    )


def _to_floor(calibration: Calibration, rocking: Rocking, rays: Float64Array) -> _FloorPoints:
    pitch, roll, height = _mounting(calibration, rocking)
    rotation = robot_from_camera_rotation(pitch, roll, calibration.ahead_radians)
    ahead = np.column_stack([rays, np.ones(len(rays))])
    x, y, z = rotation @ ahead.T
    seen = z < 0.0
    down = np.where(seen, z, -1.0)
    points = np.column_stack([x, y]) * (-height / down)[:, None]
    by_direction = np.zeros((len(rays), 2, 3))
    by_direction[:, 0, 0] = by_direction[:, 1, 1] = -height / down
    by_direction[:, :, 2] = -points / down[:, None]
    axes = _tilt_axes(calibration, pitch, roll)
    turned = _by_rotation(axes, np.column_stack([x, y, z]))
    by_mounting = np.concatenate([by_direction @ turned, points[:, :, None]], axis=2)
    return _FloorPoints(points, seen, by_direction @ rotation[:, :2], by_mounting)


def _tilt_axes(calibration: Calibration, pitch: float, roll: float) -> Float64Array:
    """Return (2, 3): the axes in the robot frame about which pitch and roll turn.

    Pitch turns about the robot's y, after roll has turned about the optical axis; or before roll
    turns about the robot's x, where a direction in the picture points ahead.
    """
    if math.isnan(calibration.ahead_radians):
        return np.array([[0.0, 1.0, 0.0], [math.cos(pitch), 0.0, -math.sin(pitch)]])
    return np.array([[0.0, math.cos(roll), math.sin(roll)], [1.0, 0.0, 0.0]])


def _by_rotation(axes: Float64Array, directions: Float64Array) -> Float64Array:
    """Return (N, 3, 2): how directions in the robot frame change with pitch and roll."""
    x, y, z = directions.T
    turned = np.empty((len(directions), 3, 2))
    for column, (a, b, c) in enumerate(axes.tolist()):
        turned[:, 0, column] = b * z - c * y
        turned[:, 1, column] = c * x - a * z
        turned[:, 2, column] = a * y - b * x
    return turned


def _to_ray(calibration: Calibration, rocking: Rocking, points: Float64Array) -> _FloorRays:
    pitch, roll, height = _mounting(calibration, rocking)
    rotation = robot_from_camera_rotation(pitch, roll, calibration.ahead_radians)
    axes = _tilt_axes(calibration, pitch, roll)
    directions = np.column_stack([points, np.full(len(points), -height)])
    optical = directions @ rotation
    seen = optical[:, 2] > 0.0
    depth = np.where(seen, optical[:, 2], 1.0)
    rays = optical[:, :2] / depth[:, None]
    by_optical = np.zeros((len(points), 2, 3))
    by_optical[:, 0, 0] = by_optical[:, 1, 1] = 1.0 / depth
    by_optical[:, :, 2] = -rays / depth[:, None]
    by_direction = by_optical @ rotation.T
    # As the camera turns, directions in its frame turn the other way.
    turned = -_by_rotation(axes, directions)
    sunk = np.zeros((len(points), 3, 1))
    sunk[:, 2, 0] = -height
    by_mounting = by_direction @ np.concatenate([turned, sunk], axis=2)
    return _FloorRays(rays, seen, by_direction[:, :, :2], by_mounting)


def _by_motion(points: Float64Array) -> Float64Array:
    """Return (N, 2, 3): how points move with x, y and theta of their own frame of reference."""
    moved = np.zeros((len(points), 2, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = 1.0
    moved[:, 0, 2], moved[:, 1, 2] = -points[:, 1], points[:, 0]
    return moved
