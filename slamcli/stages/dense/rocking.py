"""A camera that rocks: by how much its views show the floor elsewhere."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import apply_homography
from slamcli.stages import camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.records import Calibration

# A robot that rocks by a radian bounces by so many times its camera's height.
_HEIGHT_SHARE_PER_RADIAN = 3.0


def mounting_sigmas(calibration: Calibration, tilt_sigma_radians: float) -> NDArray[np.float64]:
    """Return (3,) sigmas of a frame's pitch, roll and height; (0,) for a camera without them."""
    if not math.isfinite(calibration.height_metres) or tilt_sigma_radians <= 0.0:
        return np.zeros(0)
    height = _HEIGHT_SHARE_PER_RADIAN * tilt_sigma_radians * calibration.height_metres
    return np.array([tilt_sigma_radians, tilt_sigma_radians, height])


def shown_from_floor(
    calibration: Calibration, mounting: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (3, 3): where a view made by the calibration shows the floor of a tilted frame."""
    if not np.any(mounting):
        return np.eye(3)
    tilted = camera.image_from_robot_homography(
        calibration.camera_matrix,
        calibration.height_metres + float(mounting[2]),
        calibration.pitch_radians + float(mounting[0]),
        calibration.roll_radians + float(mounting[1]),
    )
    shown = calibration.robot_from_image @ tilted
    return np.asarray(shown / shown[2, 2])


def shifts(
    calibration: Calibration, points: NDArray[np.float64], sigmas: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 2, 3): metres by which points are shown elsewhere, for one sigma of each."""
    shifts = np.empty((len(points), 2, len(sigmas)))
    for number, sigma in enumerate(sigmas):
        changed = np.zeros(len(sigmas))
        changed[number] = sigma
        shifts[:, :, number] = (
            apply_homography(shown_from_floor(calibration, changed), points) - points
        )
    return shifts


def slopes(
    gradients_a: NDArray[np.float64],
    gradients_b: NDArray[np.float64],
    shifts_a: NDArray[np.float64],
    shifts_b: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return (N, 2 K): how residuals change with either frame's rocking, a's before b's.

    Parameters
    ----------
    gradients_a, gradients_b : (N, 2) float64
        Of view a's picture, in a's axes and in b's.
    shifts_a, shifts_b : (N, 2, K) float64
        From `shifts`, each in its own frame's axes.
    """
    return np.hstack(
        [
            -np.einsum("ni,nik->nk", gradients_a, shifts_a),
            np.einsum("ni,nik->nk", gradients_b, shifts_b),
        ]
    )
