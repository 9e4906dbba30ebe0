"""From points of known place on the floor to the camera above it, with a sigma for each number.

The camera is a pinhole with square pixels; without intrinsics its principal point is the picture's
middle and its focal length is solved for. Four corners of a square fix a homography, and with it
the image of the absolute conic gives two linear equations in 1 / f^2 (Hartley and Zisserman,
Multiple View Geometry, 2nd ed., 8.8 and example 8.18: the images of two perpendicular floor
directions of equal length). The pose follows from the homography's columns (Zhang, A flexible new
technique for camera calibration, PAMI 2000, 3.1), and Levenberg-Marquardt on the reprojection of
the points, weighted by their covariance, refines all of it and yields the sigmas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import Pose2, apply_homography, invert
from slamcli.core.records import Calibration, Intrinsics
from slamcli.stages import camera

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

# Focal lengths, in picture widths, that a robot's camera may have: 143 to 14 degrees of view
# to the sides are inside of it, with room.
FOCAL_RANGE_WIDTHS = (0.3, 4.0)
# Beyond this the height and the pitch are guesses too.
_MOST_FOCAL_SIGMA_SHARE = 0.25
_STEEPEST_PITCH_RADIANS = math.radians(89.9)
_SEARCH_STEPS = 33
# A square that fits no better than this many sigmas is told of.
MISFIT_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class FloorPoints:
    """Points of a flat target on the floor, and where they are seen.

    Attributes
    ----------
    target : (N, 2) float64, metres
        In the target's own axes, x to the right and y away or any other way about.
    pixels : (N, 2) float64
        Undistorted.
    covariance : (2N, 2N) float64, pixels squared
        Of pixels (x0, y0, x1, ...).
    """

    target: NDArray[np.float64]
    pixels: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """The camera that explains the points best.

    Attributes
    ----------
    focal_pixels : float
        The geometric mean of both axes when intrinsics were given.
    height_metres, pitch_radians, roll_radians : float
    sigmas : (4,) float64
        Of focal, height, pitch, roll in the units above; focal 0 when it was given.
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
    sigmas: NDArray[np.float64]
    robot_from_target: Pose2
    residual_pixels: float
    misfit_sigmas: float


def square_target(side_metres: float) -> NDArray[np.float64]:
    """Return (4, 2) corners, metres, clockwise as the camera sees them (y up in this frame)."""
    half = side_metres / 2.0
    return np.array([[-half, half], [half, half], [half, -half], [-half, -half]])


def sort_corners(corners: ArrayLike, image_size: tuple[int, int]) -> NDArray[np.float64]:
    """Return four corners clockwise in the picture, from the upper left.

    Raises
    ------
    CalibrationError
        When they are not four corners of a convex quadrilateral inside the picture.
    """
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    text = " ".join(f"{x:g},{y:g}" for x, y in points)
    if len(points) != 4 or not np.all(np.isfinite(points)):
        raise CalibrationError(f"--corners '{text}': four points 'x,y x,y x,y x,y' are needed")
    width, height = image_size
    if np.any(points < -0.5) or np.any(points > (width - 0.5, height - 0.5)):
        raise CalibrationError(
            f"--corners '{text}': all must lie inside the photo of {width}x{height} pixels"
        )
    middle = points.mean(axis=0)
    angles = np.arctan2(points[:, 1] - middle[1], points[:, 0] - middle[0])
    ordered = points[np.argsort(angles, kind="stable")]
    ordered = np.roll(ordered, -int(np.argmin(ordered.sum(axis=1))), axis=0)
    along = np.roll(ordered, -1, axis=0) - ordered
    following = np.roll(along, -1, axis=0)
    lengths = np.linalg.norm(along, axis=1)
    if lengths.min() < 2.0:
        raise CalibrationError(f"--corners '{text}': two corners are the same point")
    turn = along[:, 0] * following[:, 1] - along[:, 1] * following[:, 0]
    if np.any(turn < 0.01 * lengths * np.roll(lengths, -1)):
        raise CalibrationError(
            f"--corners '{text}': three lie on a line or one lies inside the others; "
            "give the four corners of the square"
        )
    return ordered


def fit_homography(target: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) homography pixel_from_target by the normalised direct linear transform."""
    target_scaling, pixel_scaling = _normalising(target), _normalising(pixels)
    source = apply_homography(target_scaling, target)
    x, y = apply_homography(pixel_scaling, pixels).T
    ones, zeros = np.ones(len(source)), np.zeros((len(source), 3))
    rays = np.column_stack([source, ones])
    rows = np.concatenate(
        [
            np.hstack([rays, zeros, -x[:, None] * rays]),
            np.hstack([zeros, rays, -y[:, None] * rays]),
        ]
    )
    _, _, right = np.linalg.svd(rows)
    homography = invert(pixel_scaling) @ right[-1].reshape(3, 3) @ target_scaling
    result: NDArray[np.float64] = homography / np.linalg.norm(homography)
    return result


def focal_from_homography(
    centred_from_target: NDArray[np.float64], width_pixels: float
) -> float | None:
    """Return the focal length, pixels, in closed form, or None where the picture does not tell it.

    Parameters
    ----------
    centred_from_target : (3, 3)
        Homography to pixels counted from the principal point.
    width_pixels : float
        Of the picture, to make the two equations alike in size.

    Notes
    -----
    With w = 1 / f^2 and columns h1, h2, perpendicular directions give
    (h1x h2x + h1y h2y) w + h1z h2z = 0 and equal lengths
    (h1x^2 + h1y^2 - h2x^2 - h2y^2) w + h1z^2 - h2z^2 = 0. Both together, by least squares, hold
    for a square at any angle; a square seen straight on leaves only the second, a camera that
    looks straight down neither.
    """
    scaled = np.diag([1.0 / width_pixels, 1.0 / width_pixels, 1.0]) @ centred_from_target
    first, second = scaled[:, 0], scaled[:, 1]
    gain = np.array([first[:2] @ second[:2], first[:2] @ first[:2] - second[:2] @ second[:2]])
    constant = np.array([first[2] * second[2], first[2] ** 2 - second[2] ** 2])
    power = float(gain @ gain)
    inverse_square = -float(gain @ constant) / power if power > 0 else 0.0
    if inverse_square <= 0:
        return None
    widths = 1.0 / math.sqrt(inverse_square)
    low, high = FOCAL_RANGE_WIDTHS
    return widths * width_pixels if low <= widths <= high else None


def solve_mounting(points: FloorPoints, image_size: tuple[int, int]) -> Mounting:
    """Solve for focal length, height, pitch and roll of a camera without known intrinsics.

    Raises
    ------
    CalibrationError
        When the points do not tell the focal length, or no camera above the floor sees them so.
    """
    width = float(image_size[0])
    centre = camera.image_centre(image_size)
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
    if not share < _MOST_FOCAL_SIGMA_SHARE:
        raise CalibrationError(
            f"this view of the square leaves the focal length open (±{share:.0%}); tilt the camera "
            "less steeply, bring the square nearer, or give --intrinsics camera_info.yaml"
        )
    return mounting


def solve_mounting_with_intrinsics(points: FloorPoints, intrinsics: Intrinsics) -> Mounting:
    """Solve for height, pitch and roll of a camera whose intrinsics are known.

    Raises
    ------
    CalibrationError
        When no camera above the floor sees the points so.
    """
    return _refine(points, intrinsics.camera_matrix, focal_free=False)


def make_calibration(
    mounting: Mounting,
    image_size: tuple[int, int],
    intrinsics: Intrinsics | None,
    max_range_metres: float | None,
) -> Calibration:
    """Return the record; the far limit is chosen by the sampling unless it is given.

    Raises
    ------
    CalibrationError
        When nothing of the floor is within the far limit.
    """
    if intrinsics is None:
        column, row = camera.image_centre(image_size)
        focal = mounting.focal_pixels
        matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
        intrinsics = Intrinsics(matrix, np.zeros(5), "plumb_bob", image_size)
    matrix = intrinsics.camera_matrix
    image_from_robot = camera.image_from_robot_homography(
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
            camera.choose_max_range(matrix, image_from_robot, image_size)
            if max_range_metres is None
            else max_range_metres
        ),
        focal_sigma_pixels=float(mounting.sigmas[0]),
        height_sigma_metres=float(mounting.sigmas[1]),
        pitch_sigma_radians=float(mounting.sigmas[2]),
        roll_sigma_radians=float(mounting.sigmas[3]),
    )
    camera.seen_floor(calibration)
    return calibration


def squareness(
    corners: NDArray[np.float64],
    image_size: tuple[int, int],
    intrinsics: Intrinsics | None,
    tolerance_pixels: float,
) -> float:
    """Return how well four corners may be a square on the floor before a robot, in [0, 1].

    For each focal length that a camera may have (or the one that is known) the corners' two floor
    directions should be perpendicular and equally long; the best is taken, then weighed by how
    plausible its pitch and roll are. A wall's rectangle looks like a floor seen from straight
    above, a ceiling's like one seen from below.

    Parameters
    ----------
    corners : (4, 2)
        Undistorted pixels, clockwise in the picture.
    image_size, intrinsics
    tolerance_pixels : float
        How far the corners may be off, for the lens and the floor's unevenness.
    """
    homography = fit_homography(square_target(1.0), corners)
    if intrinsics is None:
        column, row = camera.image_centre(image_size)
        low, high = FOCAL_RANGE_WIDTHS
        centring = np.array([[1.0, 0.0, -column], [0.0, 1.0, -row], [0.0, 0.0, 1.0]])
        closed_form = focal_from_homography(centring @ homography, float(image_size[0]))
        focals = [*(image_size[0] * np.geomspace(low, high, _SEARCH_STEPS))]
        focals += [] if closed_form is None else [closed_form]
        matrices = [np.array([[f, 0, column], [0, f, row], [0, 0, 1.0]]) for f in focals]
    else:
        matrices = [intrinsics.camera_matrix]
    # Seen at a grazing angle a square is flat in the picture, and a pixel up or down is much.
    diagonals = corners[2] - corners[0], corners[3] - corners[1]
    area = 0.5 * abs(float(diagonals[0][0] * diagonals[1][1] - diagonals[0][1] * diagonals[1][0]))
    longest = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).max())
    tolerance = tolerance_pixels * longest / area
    best = 0.0
    for matrix in matrices:
        columns = invert(matrix) @ homography
        first, second = columns[:, 0], columns[:, 1]
        lengths = np.linalg.norm(first), np.linalg.norm(second)
        skew = float(first @ second) / float(lengths[0] * lengths[1])
        stretch = math.log(float(lengths[0] / lengths[1]))
        up, _ = _floor_axes(columns)
        pitch, roll = _tilt(up)
        fit = math.exp(-0.5 * (skew**2 + stretch**2) / tolerance**2)
        best = max(best, fit * _plausible(pitch, roll))
    return best


def _plausible(pitch_radians: float, roll_radians: float) -> float:
    """Weigh a mounting: a robot's camera looks down by 5 to 75 degrees and is about level."""
    pitch, roll = math.degrees(pitch_radians), math.degrees(roll_radians)
    outside = max(5.0 - pitch, pitch - 75.0, 0.0)
    return math.exp(-0.5 * ((outside / 6.0) ** 2 + (roll / 15.0) ** 2))


def _refine(
    points: FloorPoints, camera_matrix: NDArray[np.float64], *, focal_free: bool
) -> Mounting:
    """Run Levenberg-Marquardt on (log f,) log height, pitch, roll, x, y, yaw."""
    parameters = _start(points, camera_matrix)
    if not focal_free:
        parameters = parameters[1:]
    whiten = invert(np.asarray(np.linalg.cholesky(points.covariance), dtype=np.float64))

    def unpack(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return values if focal_free else np.concatenate([[0.0], values])

    def residuals(values: NDArray[np.float64]) -> NDArray[np.float64]:
        projected = _project(points.target, camera_matrix, unpack(values))
        return np.asarray(whiten @ (projected - points.pixels).ravel(), dtype=np.float64)

    try:
        solution = least_squares(residuals, parameters, method="lm", x_scale="jac", max_nfev=2000)
    except ValueError as error:
        raise CalibrationError("no camera above the floor sees the corners like this") from error
    values = unpack(solution.x)
    _, height, pitch, roll, x, y, yaw = values
    if not abs(pitch) <= _STEEPEST_PITCH_RADIANS or abs(roll) > math.pi / 2 or abs(height) > 20:
        raise CalibrationError("no camera above the floor sees the corners like this")
    freedom = max(len(solution.fun) - len(solution.x), 1)
    misfit = math.sqrt(float(solution.fun @ solution.fun) / freedom)
    jacobian = np.asarray(solution.jac, dtype=np.float64)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(1.0, misfit) ** 2
    sigma = np.sqrt(np.diag(covariance))[: 4 if focal_free else 3]
    focal = math.sqrt(float(camera_matrix[0, 0] * camera_matrix[1, 1])) * math.exp(values[0])
    focal_sigma = focal * float(sigma[0]) if focal_free else 0.0
    height_sigma, pitch_sigma, roll_sigma = sigma[-3:]
    parting = _project(points.target, camera_matrix, values) - points.pixels
    return Mounting(
        focal_pixels=focal,
        height_metres=math.exp(height),
        pitch_radians=float(pitch),
        roll_radians=float(roll),
        sigmas=np.array([focal_sigma, math.exp(height) * height_sigma, pitch_sigma, roll_sigma]),
        robot_from_target=Pose2(float(x), float(y), float(yaw)),
        residual_pixels=float(np.sqrt(np.mean(np.sum(parting**2, axis=1)))),
        misfit_sigmas=misfit,
    )


def _project(
    target: NDArray[np.float64], camera_matrix: NDArray[np.float64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    log_zoom, log_height, pitch, roll, x, y, yaw = (float(value) for value in values)
    zoomed = camera_matrix @ np.diag([math.exp(log_zoom), math.exp(log_zoom), 1.0])
    homography = camera.image_from_robot_homography(zoomed, math.exp(log_height), pitch, roll)
    return apply_homography(homography, Pose2(x, y, yaw).apply(target))


def _start(points: FloorPoints, camera_matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (7,) starting values from the homography's columns; log zoom 0."""
    columns = invert(camera_matrix) @ fit_homography(points.target, points.pixels)
    up, scale = _floor_axes(columns)
    pitch, roll = _tilt(up)
    origin = columns[:, 2] / scale
    height = -float(origin @ up)
    if height <= 0:
        raise CalibrationError("no camera above the floor sees the corners like this")
    image_from_robot = camera.image_from_robot_homography(camera_matrix, height, pitch, roll)
    floor = apply_homography(invert(image_from_robot), points.pixels)
    # The least-squares rotation between two point sets (Umeyama, PAMI 1991), in the plane.
    target_centred = points.target - points.target.mean(axis=0)
    floor_centred = floor - floor.mean(axis=0)
    cosine = float(np.sum(target_centred * floor_centred))
    sine = float(np.sum(target_centred[:, 0] * floor_centred[:, 1]))
    sine -= float(np.sum(target_centred[:, 1] * floor_centred[:, 0]))
    yaw = math.atan2(sine, cosine)
    middle = floor.mean(axis=0) - Pose2(0.0, 0.0, yaw).apply(points.target.mean(axis=0))
    return np.array([0.0, math.log(height), pitch, roll, middle[0], middle[1], yaw])


def _floor_axes(columns: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the floor's upward unit normal in optical axes, and the homography's signed scale.

    The target's axes are right-handed seen from above, so x cross y is up; the scale's sign is
    the one that puts the target in front of the camera.
    """
    first, second = columns[:, 0], columns[:, 1]
    scale = math.sqrt(float(np.linalg.norm(first) * np.linalg.norm(second)))
    if columns[2, 2] < 0:
        scale = -scale
    normal = np.cross(first / scale, second / scale)
    return normal / np.linalg.norm(normal), scale


def _tilt(up: NDArray[np.float64]) -> tuple[float, float]:
    """Return pitch and roll, radians, from the upward normal in optical axes (x right, y down)."""
    return math.asin(float(np.clip(-up[2], -1.0, 1.0))), math.atan2(-up[0], -up[1])


def _normalising(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) similarity that centres points and brings them to unit spread."""
    middle = points.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
    scale = math.sqrt(2.0) / max(spread, 1e-12)
    return np.array(
        [[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]], [0.0, 0.0, 1.0]]
    )
