"""Cuboids drawn into a simulated image, hidden faces removed."""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import distort_points, image_centre
from slamcli.core.camera.mounting import robot_from_camera_rotation
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.simulation.photograph.world import Box


def draw_boxes(
    image: Float32Array,
    boxes: tuple[Box, ...],
    world_from_robot: Pose2,
    calibration: Calibration,
    stamp: float,
) -> None:
    """Draw cuboids into an image, far ones first; one partly behind the camera is left out."""
    faces = []
    for box in boxes:
        moved = Pose2(
            box.world_from_box.x + stamp * box.velocity[0],
            box.world_from_box.y + stamp * box.velocity[1],
            box.world_from_box.theta,
        )
        faces += _box_faces(box, world_from_robot.inverse() @ moved, calibration)
    for _, polygon, colour in sorted(faces, key=lambda face: -face[0]):
        fixed = np.round(polygon * 16).astype(np.int32)
        cv2.fillConvexPoly(image, fixed, colour, cv2.LINE_AA, 4)


def _box_faces(
    box: Box, robot_from_box: Pose2, calibration: Calibration
) -> list[tuple[float, Float64Array, tuple[float, float, float]]]:
    """Return (distance, (N, 2) pixels, colour) of the faces that are turned towards the camera."""
    length, width, height = box.size_metres
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    base = robot_from_box.apply(outline)
    bottom = np.column_stack([base, np.zeros(4)])
    top = np.column_stack([base, np.full(4, height)])
    eye = np.array([0.0, 0.0, calibration.height_metres])
    candidates = [(top, 1.0)]
    for side in range(4):
        following = (side + 1) % 4
        corners = np.array([bottom[side], bottom[following], top[following], top[side]])
        candidates.append((corners, 0.55 + 0.1 * side))
    faces = []
    for corners, shade in candidates:
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        if normal @ (eye - corners[0]) <= 0:
            continue
        rim = np.concatenate(
            [
                np.linspace(corners[number - 1], corners[number], 6, endpoint=False)
                for number in range(len(corners))
            ]
        )
        pixels = _project(rim, calibration)
        if pixels is not None:
            distance = float(np.linalg.norm(corners.mean(axis=0) - eye))
            faces.append((distance, pixels, tuple(shade * value for value in box.colour)))
    return faces  # type: ignore[return-value]


def _project(points: Float64Array, calibration: Calibration) -> Float64Array | None:
    """Project (N, 3) robot points, metres, to pixels; None when one is not well ahead."""
    rotation = robot_from_camera_rotation(
        calibration.pitch_radians, calibration.roll_radians, calibration.ahead_radians
    )
    rays = (points - (0.0, 0.0, calibration.height_metres)) @ rotation
    if rays[:, 2].min() < 0.05:
        return None
    undistorted = apply_homography(calibration.camera_matrix, rays[:, :2] / rays[:, 2:])
    # Far outside the image the lens polynomial folds back into it.
    reach = 0.9 if np.any(calibration.distortion) else 4.0
    centre = np.array(image_centre(calibration.image_size))
    if np.abs(undistorted - centre).max() > reach * max(calibration.image_size):
        return None
    return distort_points(calibration, undistorted)
