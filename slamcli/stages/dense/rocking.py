"""A camera that rocks: by how much its views show the floor elsewhere."""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import apply_homography

# A robot that rocks by a radian bounces by so many times its camera's height.
_HEIGHT_SHARE_PER_RADIAN = 3.0


def mounting_sigmas(calibration: Calibration, tilt_sigma_radians: float) -> Float64Array:
    """Return (3,) sigmas of a frame's pitch, roll and height; (0,) for a camera without them."""
    if not math.isfinite(calibration.height_metres) or tilt_sigma_radians <= 0.0:
        return np.zeros(0)
    height = _HEIGHT_SHARE_PER_RADIAN * tilt_sigma_radians * calibration.height_metres
    return np.array([tilt_sigma_radians, tilt_sigma_radians, height])


def shown_from_floor(calibration: Calibration, mounting: Float64Array) -> Float64Array:
    """Return (3, 3): where a view made by the calibration shows the floor of a tilted frame."""
    if not np.any(mounting):
        return np.eye(3)
    tilted = image_from_robot_homography(
        calibration.camera_matrix,
        calibration.height_metres + float(mounting[2]),
        calibration.pitch_radians + float(mounting[0]),
        calibration.roll_radians + float(mounting[1]),
    )
    shown = calibration.robot_from_image @ tilted
    return np.asarray(shown / shown[2, 2])


def shown_from_floor_by_each(calibration: Calibration, sigmas: Float64Array) -> Float64Array:
    """Return (K, 3, 3): `shown_from_floor` with one sigma of each in turn."""
    return np.array(
        [shown_from_floor(calibration, row) for row in np.diag(sigmas)], dtype=np.float64
    ).reshape(-1, 3, 3)


def shifts(shown_from_floor_by_each: Float64Array, points: Float64Array) -> Float64Array:
    """Return (K, 2, N): metres by which (N, 2) points are shown elsewhere, for one sigma of each.

    The points run along the last axis, as in `slopes`: numpy is slow along axes as short as two.
    """
    shifts = np.empty((len(shown_from_floor_by_each), 2, len(points)))
    for shift, homography in zip(shifts, shown_from_floor_by_each, strict=True):
        np.subtract(apply_homography(homography, points).T, points.T, out=shift)
    return shifts


def slopes(
    gradients_a: Float64Array,
    gradients_b: Float64Array,
    shifts_a: Float64Array,
    shifts_b: Float64Array,
) -> Float64Array:
    """Return (2 K, N): how residuals change with either frame's rocking, a's before b's.

    Parameters
    ----------
    gradients_a, gradients_b : (N, 2) float64
        Of view a's picture, in a's axes and in b's.
    shifts_a, shifts_b : (K, 2, N) float64
        From `shifts`, each in its own frame's axes.
    """
    slopes_a = shifts_a[:, 0] * gradients_a[:, 0] + shifts_a[:, 1] * gradients_a[:, 1]
    slopes_b = shifts_b[:, 0] * gradients_b[:, 0] + shifts_b[:, 1] * gradients_b[:, 1]
    return np.concatenate([-slopes_a, slopes_b])
