"""Mounting from floor points by Levenberg-Marquardt, with a standard deviation of each number.

The pose follows from the homography's columns (Zhang, A flexible new technique for camera
calibration, PAMI 2000, 3.1); least squares on the reprojection of the points, weighted by their
covariance, refines it together with the focal length where that is not known.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.camera.footprint import choose_max_range, seen_floor
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.mounting import image_from_robot_homography
from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.robust import fit_rigid_2d
from slamcli.stages.calibrate.closed_form import (
    fit_homography,
    floor_axes,
    focal_from_homography,
    tilt,
)

# Beyond this the height and the pitch are guesses too [guarded by tests/run/test_calibrate.py].
_MAX_FOCAL_SIGMA_SHARE = 0.25
# Nearer to straight down, the direction ahead and the roll are noise.
_MAX_PITCH_RADIANS = math.radians(89.9)
_MAX_LOG_HEIGHT = 20.0
# A residual of more sigmas than this is reported: the target may be no flat square.
MISFIT_SIGMAS = 4.0
_NO_CAMERA = (
    "no camera above the floor sees the corners like this; check the corners and the side's length"
)


@dataclass(frozen=True, slots=True, eq=False)
class FloorPoints:
    """Points of a flat calibration target on the floor, and the pixels that show them.

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
    height_metres, pitch_radians, roll_radians : float
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


def solve_mounting(points: FloorPoints, image_size: tuple[int, int]) -> Mounting:
    """Solve for focal length, height, pitch and roll of a camera without known intrinsics.

    Raises
    ------
    CalibrationError
        When the points do not determine the focal length, or no camera above the floor sees them
        like this.
    """
    width = float(image_size[0])
    centre = image_centre(image_size)
    centring = np.array([[1.0, 0.0, -centre[0]], [0.0, 1.0, -centre[1]], [0.0, 0.0, 1.0]])
    homography = centring @ fit_homography(points.target, points.pixels)
    closed_form = focal_from_homography(homography, width)
    search = width * np.geomspace(0.5, 2.5, 4)
    starts = [float(focal) for focal in search] if closed_form is None else [closed_form]
    fits = []
    for focal in starts:
        matrix = invert(centring) @ np.diag([focal, focal, 1.0])
        fits.append(_refine(points, matrix, focal_free=True))
    mounting = min(fits, key=lambda fit: fit.misfit_sigmas)
    share = float(mounting.sigmas[0]) / mounting.focal_pixels
    if not share < _MAX_FOCAL_SIGMA_SHARE:
        raise CalibrationError(
            "this view of the square does not determine the focal length (±"
            f"{share:.0%}); tilt the camera less steeply, bring the square nearer, or give "
            "--intrinsics camera_info.yaml"
        )
    return mounting


def solve_mounting_with_intrinsics(points: FloorPoints, intrinsics: Intrinsics) -> Mounting:
    """Solve for height, pitch and roll of a camera whose intrinsics are known.

    Raises
    ------
    CalibrationError
        When no camera above the floor sees the points like this.
    """
    return _refine(points, intrinsics.camera_matrix, focal_free=False)


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
        intrinsics = Intrinsics(matrix, np.zeros(5), "plumb_bob", image_size)
    matrix = intrinsics.camera_matrix
    image_from_robot = image_from_robot_homography(
        matrix, mounting.height_metres, mounting.pitch_radians, mounting.roll_radians
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


def _refine(points: FloorPoints, camera_matrix: Float64Array, *, focal_free: bool) -> Mounting:
    """Run Levenberg-Marquardt on (log zoom,) log height, pitch, roll, x, y, yaw."""
    start = _start(points, camera_matrix)
    whiten = invert(np.asarray(np.linalg.cholesky(points.covariance), dtype=np.float64))

    def unpack(values: Float64Array) -> Float64Array:
        return values if focal_free else np.concatenate([[0.0], values])

    # Slow to load, and not needed to read a calibration.
    from scipy.optimize import least_squares

    def residuals(values: Float64Array) -> Float64Array:
        projected = _project(points.target, camera_matrix, unpack(values))
        return whiten @ (projected - points.pixels).ravel()

    try:
        solution = least_squares(
            residuals, start if focal_free else start[1:], method="lm", x_scale="jac", max_nfev=2000
        )
    except ValueError as error:
        raise CalibrationError(_NO_CAMERA) from error
    values = unpack(solution.x)
    _check_mounting(values)
    freedom = max(len(solution.fun) - len(solution.x), 1)
    misfit = math.sqrt(float(solution.fun @ solution.fun) / freedom)
    jacobian = np.asarray(solution.jac, dtype=np.float64)
    inverse = np.linalg.pinv(jacobian.T @ jacobian)
    covariance = np.asarray(inverse * max(1.0, misfit) ** 2, dtype=np.float64)
    if not focal_free:
        covariance = np.pad(covariance, ((1, 0), (1, 0)))
    return _to_mounting(points, camera_matrix, values, covariance[:4, :4], misfit)


def _check_mounting(values: Float64Array) -> None:
    """Raise CalibrationError for a camera that is not above the floor, or looks straight down."""
    _, log_height, pitch, roll, *_ = values
    if pitch > _MAX_PITCH_RADIANS:
        raise CalibrationError(
            "the camera looks straight down, so that the focal length and the direction ahead are "
            "not determined; tilt the camera, or give --intrinsics camera_info.yaml"
        )
    if abs(roll) > math.pi / 2 or pitch < -math.pi / 2 or abs(log_height) > _MAX_LOG_HEIGHT:
        raise CalibrationError(_NO_CAMERA)


def _to_mounting(
    points: FloorPoints,
    camera_matrix: Float64Array,
    values: Float64Array,
    covariance: Float64Array,
    misfit_sigmas: float,
) -> Mounting:
    """Return the mounting of (7,) values and the covariance of the first four."""
    sigmas = np.sqrt(np.diag(covariance))
    log_zoom, log_height, pitch, roll, x, y, yaw = values
    focal = math.sqrt(float(camera_matrix[0, 0] * camera_matrix[1, 1])) * math.exp(log_zoom)
    height = math.exp(log_height)
    difference = _project(points.target, camera_matrix, values) - points.pixels
    return Mounting(
        focal_pixels=focal,
        height_metres=height,
        pitch_radians=float(pitch),
        roll_radians=float(roll),
        sigmas=np.array([focal * sigmas[0], height * sigmas[1], sigmas[2], sigmas[3]]),
        covariance=covariance,
        robot_from_target=Pose2(float(x), float(y), float(yaw)),
        residual_pixels=float(np.sqrt(np.mean(np.sum(difference**2, axis=1)))),
        misfit_sigmas=misfit_sigmas,
    )


def _project(
    target: Float64Array, camera_matrix: Float64Array, values: Float64Array
) -> Float64Array:
    log_zoom, log_height, pitch, roll, x, y, yaw = (float(value) for value in values)
    zoomed = camera_matrix @ np.diag([math.exp(log_zoom), math.exp(log_zoom), 1.0])
    homography = image_from_robot_homography(zoomed, math.exp(log_height), pitch, roll)
    return apply_homography(homography, Pose2(x, y, yaw).apply(target))


def _start(points: FloorPoints, camera_matrix: Float64Array) -> Float64Array:
    """Return (7,) starting values from the homography's columns; log zoom 0."""
    columns = invert(camera_matrix) @ fit_homography(points.target, points.pixels)
    up, scale = floor_axes(columns)
    pitch, roll = tilt(up)
    origin = columns[:, 2] / scale
    height = -float(origin @ up)
    if height <= 0:
        raise CalibrationError(_NO_CAMERA)
    image_from_robot = image_from_robot_homography(camera_matrix, height, pitch, roll)
    floor = apply_homography(invert(image_from_robot), points.pixels)
    placed = fit_rigid_2d(floor, points.target)
    return np.array([0.0, math.log(height), pitch, roll, placed.x, placed.y, placed.theta])
