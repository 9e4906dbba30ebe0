"""What a calibration photo determines of a camera, and the calibration that follows from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.camera.footprint import choose_max_range, seen_floor
from slamcli.core.camera.lens import distort_points, image_centre, undistort_points
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.geometry import Pose2, apply_homography, invert

# A residual of more sigmas than this is reported: the target may be no flat square.
MISFIT_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class FloorPoints:
    """Points of a flat calibration target on the floor, and the pixels that show them.

    Where the lens is not known, and is not to be estimated, pixels are taken to be undistorted.

    Attributes
    ----------
    target : (N, 2) float64, metres
        In the target's own axes, x to the right and y away or any other way about.
    pixels : (N, 2) float64
        Undistorted.
    covariance : (2N, 2N) float64, pixels squared
        Of pixels (x0, y0, x1, ...).
    """

    target: Float64Array
    pixels: Float64Array
    covariance: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """Result of the fit: the camera's focal length and mounting, and how certain they are.

    Attributes
    ----------
    focal_pixels : float
        The geometric mean of both axes when intrinsics were given.
    height_metres, pitch_radians, roll_radians, ahead_radians : float
        As in `Calibration`.
    sigmas : (4,) float64
        Of focal, height, pitch, roll in the units above; focal 0 when it was given.
    covariance : (4, 4) float64
        Of log focal, log height, pitch and roll.
    robot_from_target : Pose2
        Where the target lies on the floor.
    residual_pixels : float
        Root mean square of the reprojection.
    misfit_sigmas : float
        How unlikely the residual is, as the root of chi squared per degree of freedom.
    focal_assumed : bool
        Whether the photo left the focal length about where its prior had it.
    radial : (2,) float64
        The radial coefficients, where they were estimated.
    lens_covariance : (6, 6) float64
        Of log focal, log height, pitch, roll and the radial coefficients; zeros for these where
        they were not estimated.
    """

    focal_pixels: float
    height_metres: float
    pitch_radians: float
    roll_radians: float
    sigmas: Float64Array
    covariance: Float64Array
    robot_from_target: Pose2
    residual_pixels: float
    misfit_sigmas: float
    ahead_radians: float = math.nan
    focal_assumed: bool = False
    radial: Float64Array = field(default_factory=lambda: np.zeros(2))
    lens_covariance: Float64Array = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def radial_sigmas(self) -> Float64Array:
        """(2,): zeros where the radial coefficients were not estimated."""
        return np.sqrt(np.diag(self.lens_covariance)[4:])


def make_calibration(
    mounting: Mounting,
    image_size: tuple[int, int],
    intrinsics: Intrinsics | None,
    max_range_metres: float | None,
) -> Calibration:
    """Return the calibration; the far limit is chosen by the sampling unless it is given.

    Raises
    ------
    CalibrationError
        When nothing of the floor is within the far limit.
    """
    if intrinsics is None:
        column, row = image_centre(image_size)
        focal = mounting.focal_pixels
        matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
        distortion = np.concatenate([mounting.radial, np.zeros(3)])
        intrinsics = Intrinsics(matrix, distortion, "plumb_bob", image_size)
    matrix = intrinsics.camera_matrix
    image_from_robot = image_from_robot_homography(
        matrix,
        mounting.height_metres,
        mounting.pitch_radians,
        mounting.roll_radians,
        mounting.ahead_radians,
    )
    calibration = Calibration(
        camera_matrix=matrix,
        distortion=intrinsics.distortion,
        distortion_model=intrinsics.distortion_model,
        image_size=image_size,
        robot_from_image=invert(image_from_robot),
        height_metres=mounting.height_metres,
        pitch_radians=mounting.pitch_radians,
        roll_radians=mounting.roll_radians,
        ahead_radians=mounting.ahead_radians,
        max_range_metres=(
            choose_max_range(matrix, image_from_robot, image_size)
            if max_range_metres is None
            else max_range_metres
        ),
        focal_sigma_pixels=float(mounting.sigmas[0]),
        height_sigma_metres=float(mounting.sigmas[1]),
        pitch_sigma_radians=float(mounting.sigmas[2]),
        roll_sigma_radians=float(mounting.sigmas[3]),
        covariance=mounting.covariance,
    )
    seen_floor(calibration)
    return calibration


def lens_sigma(mounting: Mounting, calibration: Calibration) -> float:
    """Return the largest error of floor that is kept, by the lens, one sigma, of its distance.

    The distance is that from the camera; 0 where the lens was not estimated.
    """
    if not np.any(mounting.radial):
        return 0.0
    floor = seen_floor(calibration)
    seen = distort_points(calibration, apply_homography(calibration.image_from_robot, floor))
    variances, directions = np.linalg.eigh(mounting.lens_covariance)
    steps = directions * np.sqrt(np.maximum(variances, 0.0))
    squares = np.zeros(len(floor))
    for step in steps.T:
        other = _changed(mounting, calibration, step)
        there = apply_homography(other.robot_from_image, undistort_points(other, seen))
        squares += np.sum((there - floor) ** 2, axis=1)
    distances = np.hypot(np.linalg.norm(floor, axis=1), calibration.height_metres)
    return float((np.sqrt(squares) / distances).max())


def _changed(mounting: Mounting, calibration: Calibration, step: Float64Array) -> Calibration:
    """Return the calibration of a mounting whose six numbers are changed."""
    zoom, grown = math.exp(float(step[0])), math.exp(float(step[1]))
    other = replace(
        mounting,
        focal_pixels=zoom * mounting.focal_pixels,
        height_metres=grown * mounting.height_metres,
        pitch_radians=mounting.pitch_radians + float(step[2]),
        roll_radians=mounting.roll_radians + float(step[3]),
        radial=mounting.radial + step[4:],
    )
    return make_calibration(other, calibration.image_size, None, calibration.max_range_metres)
