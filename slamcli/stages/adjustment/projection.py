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
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import distort_points, undistort_points
from slamcli.core.camera.mounting import compose_robot_from_image, rocked
from slamcli.core.geometry import apply_homography, invert, relative_poses
from slamcli.stages.adjustment.frame_poses import FramePose, MountedFrames

# Numbers of parameters, in the order of the Jacobians' columns: of the camera; of a frame, of which
# the first are its pose.
CAMERA_PARAMETERS = 7
FRAME_PARAMETERS = 6
POSE_PARAMETERS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """Pixels of frames a transferred to frames b; an array's last axis counts the pixels.

    Attributes
    ----------
    pixels : (2, N) float64
        In b's own image; nan behind a camera.
    by_camera : (2, 7, N) float64
        By log focal length, the first two radial coefficients, pitch and roll (rad), and the
        principal point's column and row (in focal lengths).
    by_a, by_b : (2, 6, N) float64
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
    calibration: Calibration, a: MountedFrames, b: MountedFrames, pixels_a: Float64Array
) -> Transfer:
    """Return where frames b see the floor that frames a see at (N, 2) pixels, and its derivatives.

    The frames are N, one for each pixel, or a single one for all pixels.
    """
    count = len(pixels_a)
    undistorted = undistort_points(calibration, pixels_a)
    rays = apply_homography(invert(calibration.camera_matrix), undistorted).T
    seen_a = _lens(calibration, rays)
    # The lens inverted: what moves the pixel moves the ray the other way.
    ray_by_lens = -product(_inverses(seen_a.by_ray), seen_a.by_lens)
    floor = _to_floor(a, rays)
    x, y, theta = relative_poses(b.poses, a.poses).T
    cosine, sine = np.cos(theta), np.sin(theta)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    there = product(turn, floor.points[:, None])[:, 0] + np.array([x, y])
    back = _to_ray(b, there)
    seen_b = _lens(calibration, back.rays)
    pixels = np.where(floor.seen & back.seen, seen_b.pixels, np.nan)

    pixel_by_there = product(seen_b.by_ray, back.by_points)
    pixel_by_floor = product(pixel_by_there, turn)
    by_mounting_a = product(pixel_by_floor, floor.by_mounting)
    by_mounting_b = product(seen_b.by_ray, back.by_mounting)
    by_camera = np.empty((2, CAMERA_PARAMETERS, count))
    by_lens = seen_b.by_lens + product(product(pixel_by_floor, floor.by_rays), ray_by_lens)
    by_camera[:, :3], by_camera[:, 5:] = by_lens[:, :3], by_lens[:, 3:]
    by_camera[:, 3:5] = by_mounting_a[:, :2] + by_mounting_b[:, :2]
    by_motion_a = product(pixel_by_floor, _by_motion(floor.points))
    by_motion_b = -product(pixel_by_there, _by_motion(there))
    return Transfer(
        pixels,
        by_camera,
        np.concatenate([by_motion_a, by_mounting_a], axis=1),
        np.concatenate([by_motion_b, by_mounting_b], axis=1),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _LensPixels:
    """Rays through the lens: pixels (2, N), by ray (2, 2, N), by the lens (2, 5, N).

    That is by log focal length, two radial coefficients, and the principal point.
    """

    pixels: Float64Array
    by_ray: Float64Array
    by_lens: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _FloorPoints:
    """Rays on the floor, robot frame (2, N), by ray (2, 2, N), by pitch, roll, log height."""

    points: Float64Array
    seen: BoolArray
    by_rays: Float64Array
    by_mounting: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class _FloorRays:
    """Floor points as rays (2, N), by point (2, 2, N), by pitch, roll, log height (2, 3, N)."""

    rays: Float64Array
    seen: BoolArray
    by_points: Float64Array
    by_mounting: Float64Array


def product(a: Float64Array, b: Float64Array) -> Float64Array:
    """Return (I, K, N): the products of N matrices (I, J, N) and (J, K, N).

    With the matrices along the last axis, numpy computes each element for all of them at once.
    """
    total = a[:, 0, None] * b[None, 0]
    for number in range(1, a.shape[1]):
        total += a[:, number, None] * b[None, number]
    return total


def _inverses(matrices: Float64Array) -> Float64Array:
    """Return the inverses of (2, 2, N) matrices."""
    (a, b), (c, d) = matrices
    return np.asarray(np.array([[d, -b], [-c, a]]) / (a * d - b * c))


def _lens(calibration: Calibration, rays: Float64Array) -> _LensPixels:
    matrix, distortion = calibration.camera_matrix, calibration.distortion
    still, count = np.zeros(3), rays.shape[1]
    points = np.column_stack([np.where(np.isfinite(rays), rays, 0.0).T, np.ones(count)])
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
    columns = np.asarray(jacobian, np.float64).reshape(count, 2, -1).transpose(1, 2, 0)
    focal_lengths = np.array([[matrix[0, 0]], [matrix[1, 1]]])
    by_zoom = (columns[:, focal] * focal_lengths).sum(axis=1, keepdims=True)
    by_centre = columns[:, centre] * focal_lengths
    by_lens = np.concatenate([by_zoom, columns[:, radial], by_centre], axis=1)
    pixels = np.asarray(projected, np.float64).reshape(-1, 2).T
    return _LensPixels(pixels, np.ascontiguousarray(columns[:, shift]), by_lens)


def _to_floor(frames: MountedFrames, rays: Float64Array) -> _FloorPoints:
    rotations = frames.rotations
    directions = product(rotations[:, :2], rays[:, None])[:, 0] + rotations[:, 2]
    seen = directions[2] < 0.0
    down = np.where(seen, directions[2], -1.0)
    points = directions[:2] * (-frames.heights / down)
    by_direction = np.zeros((2, 3, rays.shape[1]))
    by_direction[0, 0] = by_direction[1, 1] = -frames.heights / down
    by_direction[:, 2] = -points / down
    turned = product(by_direction, _by_rotation(frames.axes, directions))
    by_mounting = np.concatenate([turned, points[:, None]], axis=1)
    return _FloorPoints(points, seen, product(by_direction, rotations[:, :2]), by_mounting)


def _by_rotation(axes: Float64Array, directions: Float64Array) -> Float64Array:
    """Return (3, 2, N): how directions in the robot frame change with pitch and roll."""
    x, y, z = directions
    turned = np.empty((3, 2, directions.shape[1]))
    for column, (a, b, c) in enumerate(axes):
        turned[0, column] = b * z - c * y
        turned[1, column] = c * x - a * z
        turned[2, column] = a * y - b * x
    return turned


def _to_ray(frames: MountedFrames, points: Float64Array) -> _FloorRays:
    count = points.shape[1]
    heights = np.broadcast_to(frames.heights, (1, count))
    directions = np.concatenate([points, -heights])
    optical = product(directions[None], frames.rotations)[0]
    seen = optical[2] > 0.0
    depth = np.where(seen, optical[2], 1.0)
    rays = optical[:2] / depth
    by_optical = np.zeros((2, 3, count))
    by_optical[0, 0] = by_optical[1, 1] = 1.0 / depth
    by_optical[:, 2] = -rays / depth
    by_direction = product(by_optical, frames.rotations.transpose(1, 0, 2))
    # As the camera turns, directions in its frame turn the other way.
    turned = -product(by_direction, _by_rotation(frames.axes, directions))
    by_height = by_direction[:, 2:] * -heights
    by_mounting = np.concatenate([turned, by_height], axis=1)
    return _FloorRays(rays, seen, by_direction[:, :2], by_mounting)


def _by_motion(points: Float64Array) -> Float64Array:
    """Return (2, 3, N): how points move with x, y and theta of their own frame of reference."""
    moved = np.zeros((2, 3, points.shape[1]))
    moved[0, 0] = moved[1, 1] = 1.0
    moved[0, 2], moved[1, 2] = -points[1], points[0]
    return moved
