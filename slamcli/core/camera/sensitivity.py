"""Sensitivity of measured motions to errors of the calibration.

A wrong focal length, height, pitch or roll moves every floor point that a pixel is taken for. The
motion between two frames that lays the moved points onto one another is off by what no picture
shows, and all frames have it in common: lengths, and the way's curvature.
"""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.geometry import compose_poses

PARAMETERS = 4
_STEP = 1e-5
# Drawn from all of the floor in view [guarded by tests/core/camera/test_sensitivity.py].
_FLOOR_POINTS = 256
_SEED = 0
# Motions computed at a time: their floor points take 16 MB.
_BATCH = 512
# Information of a motion that no shared floor point determines: it then has no error either.
_LOOSE = 1e-9


def motion_sensitivities(calibration: Calibration, a_from_b: Float64Array) -> Float64Array:
    """Return the derivatives of measured motions by the calibration's parameters.

    Parameters
    ----------
    calibration : Calibration
        With its height, pitch and roll.
    a_from_b : (L, 3) float64
        Motions between two frames: x, y (m), theta (rad).

    Returns
    -------
    (L, 3, 4) float64
        Of the motion, in b's own axes, by log focal length, log height, pitch and roll.
    """
    floor = seen_floor(calibration)
    drawn = np.random.default_rng(_SEED).permutation(len(floor))[:_FLOOR_POINTS]
    floor = floor[drawn]
    moves = _floor_from_floor_changes(calibration)
    batches = [
        _of_batch(calibration, moves, floor, a_from_b[first : first + _BATCH])
        for first in range(0, len(a_from_b), _BATCH)
    ]
    return np.concatenate(batches) if batches else np.empty((0, 3, PARAMETERS))


def _floor_from_floor_changes(calibration: Calibration) -> Float64Array:
    """Return (4, 3, 3): derivatives of the homography from floor to floor by each parameter."""

    def floor_from_image(change: Float64Array) -> Float64Array:
        zoom = math.exp(change[0])
        return compose_robot_from_image(
            calibration.camera_matrix @ np.diag([zoom, zoom, 1.0]),
            calibration.height_metres * math.exp(change[1]),
            calibration.pitch_radians + change[2],
            calibration.roll_radians + change[3],
            calibration.ahead_radians,
        )

    changes = _STEP * np.eye(PARAMETERS)
    image_from_floor = np.linalg.inv(floor_from_image(np.zeros(PARAMETERS)))
    slopes = [
        (floor_from_image(change) - floor_from_image(-change)) @ image_from_floor / (2.0 * _STEP)
        for change in changes
    ]
    return np.array(slopes)


def _of_batch(
    calibration: Calibration, moves: Float64Array, floor: Float64Array, motions: Float64Array
) -> Float64Array:
    """Return (B, 3, 4) by least squares over the floor points that both frames see."""
    in_a = compose_poses(motions[:, None], np.column_stack([floor, np.zeros(len(floor))]))[..., :2]
    seen = _is_seen(calibration, in_a).astype(np.float64)
    turn_back = _rotations(-motions[:, 2])
    # (B, N, 2, 4), in b's axes: how much farther a's points move than b's.
    apart = np.einsum("bij,bnjk->bnik", turn_back, _moved(moves, in_a)) - _moved(moves, floor)
    turned = np.stack([-floor[:, 1], floor[:, 0]], axis=1)
    by_motion = np.concatenate(
        [np.broadcast_to(np.eye(2), (len(floor), 2, 2)), turned[:, :, None]], axis=2
    )
    normal = np.einsum("bn,nij,nik->bjk", seen, by_motion, by_motion, optimize=True)
    right = np.einsum("bn,nij,bnik->bjk", seen, by_motion, apart, optimize=True)
    solved: Float64Array = np.linalg.solve(normal + _LOOSE * np.eye(3), right)
    return solved


def _moved(moves: Float64Array, points: Float64Array) -> Float64Array:
    """Return (..., 2, 4): how points (..., 2) move by each parameter."""
    homogeneous = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    rates = np.einsum("kij,...j->...ik", moves, homogeneous)
    return np.asarray(rates[..., :2, :] - points[..., None] * rates[..., 2:, :], np.float64)


def _is_seen(calibration: Calibration, points: Float64Array) -> BoolArray:
    """Return whether floor points (..., 2) lie in the picture and within range, without lens."""
    homogeneous = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    image = homogeneous @ calibration.image_from_robot.T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = image[..., :2] / image[..., 2:]
    limits = np.array(calibration.image_size) - 1.0
    inside = np.all((pixels >= 0.0) & (pixels <= limits), axis=-1)
    near = np.hypot(points[..., 0], points[..., 1]) <= calibration.max_range_metres
    seen: BoolArray = inside & near & (image[..., 2] > 0.0)
    return seen


def _rotations(angles: Float64Array) -> Float64Array:
    cosine, sine = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([cosine, -sine], 1), np.stack([sine, cosine], 1)], axis=1)
