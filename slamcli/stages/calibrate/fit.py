"""Fit of a camera to floor points by Levenberg-Marquardt, with a standard deviation of each number.

The pose follows from the homography's columns (Zhang, A flexible new technique for camera
calibration, PAMI 2000, 3.1); least squares on the reprojection of the points, weighted by their
covariance, refines it together with the focal length and the lens where these are not known. What
the points leave open stays at its prior (maximum a posteriori): a camera that looks straight down
at a square shows the ratio of height to focal length, and neither of both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.calibration import Intrinsics
from slamcli.core.camera.lens import distort_points, image_centre
from slamcli.core.camera.mounting import image_from_robot_homography, tilt
from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.robust import fit_rigid_2d
from slamcli.stages.calibrate.closed_form import (
    FOCAL_RANGE_WIDTHS,
    fit_homography,
    floor_axes,
    focal_from_homography,
)
from slamcli.stages.calibrate.mounting import FloorPoints, Mounting

# A focal length that the points determine worse than this is estimated with its prior
# [benchmarks/calibration_targets.py].
_MAX_FOCAL_SIGMA_SHARE = 0.05
# The prior where nothing is known: webcams, phones and drones have 0.6 to 1.2 times the longer side
# of their picture, one sigma.
_USUAL_FOCAL_SIDES, _USUAL_FOCAL_SIGMA = 0.85, 0.35
# Of the radial coefficients of a lens that is not known.
_RADIAL_SIGMAS = np.array([0.3, 0.3])
# A lens is estimated from so many points at least; four corners of a square say nothing of it.
_MIN_LENS_POINTS = 12
# The least fall of chi squared that is evidence of a lens with two coefficients, as at 4 sigmas.
_MIN_LENS_GAIN = 20.0
# Steeper, a direction in the picture points ahead: about straight down the optical axis does not.
_STEEP_RADIANS = math.radians(65.0)
# Of singular values, as a share of the largest: what is smaller is not determined.
_SINGULAR = 1e-9
_MAX_LOG = 20.0
_MAX_EVALUATIONS = 500
_NO_CAMERA = (
    "no camera above the floor sees the corners like this; check the corners and the side's length"
)
# The unknowns: log zoom, two radial coefficients, log height, pitch, roll, and the target's place.
_ZOOM, _RADIAL, _MOUNT, _PLACE = slice(0, 1), slice(1, 3), slice(3, 6), slice(6, 9)
_COUNT = 9


@dataclass(frozen=True, slots=True)
class FocalPrior:
    """What is known of the focal length before the photo is measured.

    Attributes
    ----------
    pixels : float
    log_sigma : float
        One standard deviation of its logarithm.
    """

    pixels: float
    log_sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Points to be explained by a camera, and which of its numbers may change.

    Attributes
    ----------
    camera : Intrinsics
        The start, of which the points' pixels are the undistorted or, where the lens is estimated,
        the camera's own ones.
    log_sigmas : (9,) float64
        One standard deviation of each unknown's prior, about its start; infinite without.
    ahead_radians : float or None
        None to choose by the tilt.
    """

    points: FloorPoints
    camera: Intrinsics
    free: BoolArray
    sigmas: Float64Array
    ahead_radians: float | None


def usual_focal(image_size: tuple[int, int]) -> FocalPrior:
    """Return what focal length a camera has of which nothing is known."""
    return FocalPrior(_USUAL_FOCAL_SIDES * max(image_size), _USUAL_FOCAL_SIGMA)


def solve_mounting(
    points: FloorPoints,
    image_size: tuple[int, int],
    prior: FocalPrior | None = None,
    ahead_radians: float | None = None,
) -> Mounting:
    """Solve for focal length, height, pitch and roll of a camera without known intrinsics.

    The lens too, where the points are many. A focal length that they do not determine stays about
    where its prior has it, and the mounting says so.

    Parameters
    ----------
    points : FloorPoints
    image_size : (int, int)
    prior : FocalPrior or None
        None for that of a usual camera.
    ahead_radians : float or None
        Direction in the picture that points ahead, clockwise from its up; None for the optical
        axis, or the picture's up where the camera looks about straight down.

    Raises
    ------
    CalibrationError
        When no camera above the floor sees the points like this.
    """
    prior = prior or usual_focal(image_size)
    problem = _Problem(
        points,
        _camera(prior.pixels, image_size),
        _free(focal=True),
        np.full(_COUNT, np.inf),
        ahead_radians,
    )
    fits = []
    for focal in _starts(points, image_size):
        started = replace(problem, camera=_camera(focal, image_size))
        try:
            fits.append(_fit(started))
        except CalibrationError:
            continue
    low, high = (share * image_size[0] for share in FOCAL_RANGE_WIDTHS)
    best = min(fits, key=lambda fit: fit.misfit_sigmas, default=None)
    determined = (
        best is not None
        and low <= best.focal_pixels <= high
        and float(best.sigmas[0]) < _MAX_FOCAL_SIGMA_SHARE * best.focal_pixels
    )
    if best is None or not determined:
        sigmas = problem.sigmas.copy()
        sigmas[_ZOOM] = prior.log_sigma
        fit = _fit(replace(problem, sigmas=sigmas))
        best = replace(fit, focal_assumed=_is_assumed(fit, prior))
    if len(points.target) < _MIN_LENS_POINTS:
        return best
    return _with_lens(problem, prior, best)


def solve_mounting_with_intrinsics(
    points: FloorPoints, intrinsics: Intrinsics, ahead_radians: float | None = None
) -> Mounting:
    """Solve for height, pitch and roll of a camera whose intrinsics are known.

    Raises
    ------
    CalibrationError
        When no camera above the floor sees the points like this.
    """
    # The points are undistorted already.
    camera = replace(intrinsics, distortion=np.zeros(5), distortion_model="plumb_bob")
    free, sigmas = _free(focal=False), np.full(_COUNT, np.inf)
    return _fit(_Problem(points, camera, free, sigmas, ahead_radians))


def _with_lens(problem: _Problem, prior: FocalPrior, plain: Mounting) -> Mounting:
    """Return the mounting with the lens that its points show, if they show one."""
    free = problem.free.copy()
    free[_RADIAL] = True
    sigmas = problem.sigmas.copy()
    sigmas[_ZOOM], sigmas[_RADIAL] = prior.log_sigma, _RADIAL_SIGMAS
    try:
        fit = _fit(replace(problem, free=free, sigmas=sigmas))
    except CalibrationError:
        return plain
    # By the fall of chi squared: each coefficient's own sigma has that of the focal length in it.
    gain = problem.points.pixels.size * (plain.misfit_sigmas**2 - fit.misfit_sigmas**2)
    if gain < _MIN_LENS_GAIN * max(1.0, fit.misfit_sigmas) ** 2:
        return plain
    return replace(fit, focal_assumed=_is_assumed(fit, prior))


def _is_assumed(fit: Mounting, prior: FocalPrior) -> bool:
    """Return whether the points add next to nothing to what was known of the focal length."""
    return float(fit.sigmas[0]) > 0.5 * prior.log_sigma * fit.focal_pixels


def _camera(focal: float, image_size: tuple[int, int]) -> Intrinsics:
    column, row = image_centre(image_size)
    matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
    return Intrinsics(matrix, np.zeros(5), "plumb_bob", image_size)


def _free(*, focal: bool) -> BoolArray:
    free = np.ones(_COUNT, np.bool_)
    free[_ZOOM], free[_RADIAL] = focal, False
    return free


def _starts(points: FloorPoints, image_size: tuple[int, int]) -> list[float]:
    """Return focal lengths to start from."""
    width, centre = float(image_size[0]), image_centre(image_size)
    centring = np.array([[1.0, 0.0, -centre[0]], [0.0, 1.0, -centre[1]], [0.0, 0.0, 1.0]])
    homography = centring @ fit_homography(points.target, points.pixels)
    closed_form = focal_from_homography(homography, width)
    search = width * np.geomspace(0.5, 2.5, 4)
    return [float(focal) for focal in search] if closed_form is None else [closed_form]


def _fit(problem: _Problem) -> Mounting:
    """Return the best fit from the start that the homography gives, and from its mirror image.

    A target far away, or small, looks alike tilted towards the camera and away from it but for the
    perspective. Where that alone determines the focal length there is nothing to compare.
    """
    fits, error = [], CalibrationError(_NO_CAMERA)
    known = not problem.free[_ZOOM].any() or bool(np.isfinite(problem.sigmas[_ZOOM]).all())
    for mirrored in (False, True) if known else (False,):
        try:
            fits.append(_refine(problem, *_start(problem, mirrored=mirrored)))
        except CalibrationError as failure:
            error = failure
    if not fits:
        raise error
    return min(fits, key=lambda fit: fit[0])[1]


def _start(problem: _Problem, *, mirrored: bool) -> tuple[Float64Array, float]:
    """Return (9,) starting values from the homography's columns, and the direction ahead."""
    points, camera_matrix = problem.points, problem.camera.camera_matrix
    columns = invert(camera_matrix) @ fit_homography(points.target, points.pixels)
    up, scale = floor_axes(columns)
    origin = columns[:, 2] / scale
    if mirrored:
        line_of_sight = origin / np.linalg.norm(origin)
        up = 2.0 * float(up @ line_of_sight) * line_of_sight - up
    height = -float(origin @ up)
    if height <= 0:
        raise CalibrationError(_NO_CAMERA)
    ahead = problem.ahead_radians
    if ahead is None:
        ahead = 0.0 if tilt(up)[0] > _STEEP_RADIANS else math.nan
    pitch, roll = tilt(up, ahead)
    image_from_robot = image_from_robot_homography(camera_matrix, height, pitch, roll, ahead)
    floor = apply_homography(invert(image_from_robot), points.pixels)
    if not np.all(np.isfinite(floor)):
        raise CalibrationError(_NO_CAMERA)
    placed = fit_rigid_2d(floor, points.target)
    place = [math.log(height), pitch, roll, placed.x, placed.y, placed.theta]
    return np.array([0.0, 0.0, 0.0, *place]), ahead


def _refine(problem: _Problem, start: Float64Array, ahead: float) -> tuple[float, Mounting]:
    """Run Levenberg-Marquardt; return the cost and the mounting."""
    points, free = problem.points, problem.free
    whiten = invert(np.asarray(np.linalg.cholesky(points.covariance), dtype=np.float64))
    known = np.isfinite(problem.sigmas) & free

    def unpack(values: Float64Array) -> Float64Array:
        whole = start.copy()
        whole[free] = values
        return whole

    def residuals(values: Float64Array) -> Float64Array:
        whole = unpack(values)
        difference = (_project(points.target, problem.camera, whole, ahead) - points.pixels).ravel()
        return np.concatenate([whiten @ difference, whole[known] / problem.sigmas[known]])

    # Slow to load, and not needed to read a calibration.
    from scipy.optimize import least_squares

    try:
        solution = least_squares(
            residuals, start[free], method="lm", x_scale="jac", max_nfev=_MAX_EVALUATIONS
        )
    except ValueError as error:
        raise CalibrationError(_NO_CAMERA) from error
    values = unpack(solution.x)
    _check_mounting(values)
    count = points.pixels.size
    measured = solution.fun[:count]
    freedom = max(len(solution.fun) - len(solution.x), 1)
    misfit = math.sqrt(float(measured @ measured) / freedom)
    jacobian = np.asarray(solution.jac, dtype=np.float64)
    # Errors larger than their sigmas scale those of what was measured, not those of the prior.
    jacobian[:count] /= max(1.0, misfit)
    covariance = np.zeros((_COUNT, _COUNT))
    covariance[np.ix_(free, free)] = _covariance(jacobian)
    return float(solution.cost), _to_mounting(problem, values, covariance, ahead, misfit)


def _covariance(jacobian: Float64Array) -> Float64Array:
    """Return the covariance of a least-squares fit; huge for what it does not determine."""
    units = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, singular, directions = np.linalg.svd(jacobian / units, full_matrices=False)
    inverse = directions.T / np.maximum(singular, _SINGULAR * singular[0]) / units[:, None]
    covariance: Float64Array = inverse @ inverse.T
    return covariance


def _check_mounting(values: Float64Array) -> None:
    """Raise CalibrationError for a camera that is not above the floor."""
    log_height, pitch, _ = values[_MOUNT]
    if not -math.pi / 2 <= pitch <= math.pi or max(abs(log_height), abs(values[0])) > _MAX_LOG:
        raise CalibrationError(_NO_CAMERA)


def _to_mounting(
    problem: _Problem,
    values: Float64Array,
    covariance: Float64Array,
    ahead: float,
    misfit_sigmas: float,
) -> Mounting:
    """Return the mounting of (9,) values and their covariance."""
    matrix = problem.camera.camera_matrix
    log_height, pitch, roll = (float(value) for value in values[_MOUNT])
    focal = math.sqrt(float(matrix[0, 0] * matrix[1, 1])) * math.exp(float(values[0]))
    height, x, y, yaw = math.exp(log_height), *(float(value) for value in values[_PLACE])
    mounting, lens = [0, 3, 4, 5], [0, 3, 4, 5, 1, 2]
    sigmas = np.sqrt(np.diag(covariance))
    difference = _project(problem.points.target, problem.camera, values, ahead)
    difference -= problem.points.pixels
    return Mounting(
        focal_pixels=focal,
        height_metres=height,
        pitch_radians=pitch,
        roll_radians=math.remainder(roll, math.tau),
        sigmas=sigmas[mounting] * (focal, height, 1.0, 1.0),
        covariance=covariance[np.ix_(mounting, mounting)],
        robot_from_target=Pose2(x, y, yaw),
        residual_pixels=float(np.sqrt(np.mean(np.sum(difference**2, axis=1)))),
        misfit_sigmas=misfit_sigmas,
        ahead_radians=ahead,
        radial=values[_RADIAL],
        lens_covariance=covariance[np.ix_(lens, lens)],
    )


def _project(
    target: Float64Array, camera: Intrinsics, values: Float64Array, ahead: float
) -> Float64Array:
    # Where the points do not determine them these may run away, until the fit is given up.
    log_zoom, log_height = np.clip(values[[0, 3]], -_MAX_LOG, _MAX_LOG)
    zoom, pitch, roll = math.exp(log_zoom), float(values[4]), float(values[5])
    matrix = camera.camera_matrix @ np.diag([zoom, zoom, 1.0])
    homography = image_from_robot_homography(matrix, math.exp(log_height), pitch, roll, ahead)
    place = Pose2(*(float(value) for value in values[_PLACE]))
    pixels = apply_homography(homography, place.apply(target))
    if not np.any(values[_RADIAL]):
        return pixels
    distortion = np.concatenate([values[_RADIAL], np.zeros(3)])
    return distort_points(replace(camera, camera_matrix=matrix, distortion=distortion), pixels)
