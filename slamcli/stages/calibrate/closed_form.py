"""Closed-form calibration: four corners to a homography, and from it focal length and tilt.

A square's four corners fix a homography, and with it the image of the absolute conic gives two
linear equations in 1 / f^2 (Hartley and Zisserman, Multiple View Geometry, 2nd ed., 8.8 and
example 8.18: the images of two perpendicular floor directions of equal length).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Intrinsics
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.mounting import tilt
from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import apply_homography, invert

# Focal lengths, in picture widths, that a robot's camera may have: 118 to 14 degrees of view
# from side to side [guarded by tests/stages/test_square.py and tests/run/test_calibrate.py].
FOCAL_RANGE_WIDTHS = (0.3, 4.0)
_SEARCH_STEPS = 33
# A wall's rectangle looks like a floor seen from straight above, one of a ceiling like a floor seen
# by a camera that is upside down: so much less plausible are these than a camera that looks ahead.
_UNUSUAL_SHARE = 0.25


def square_target(side_metres: float) -> Float64Array:
    """Return (4, 2) corners, metres, clockwise as the camera sees them (y up in this frame)."""
    half = side_metres / 2.0
    return np.array([[-half, half], [half, half], [half, -half], [-half, -half]])


def sort_corners(corners: ArrayLike, image_size: tuple[int, int]) -> Float64Array:
    """Return four corners clockwise in the picture, from the upper left.

    Raises
    ------
    CalibrationError
        When they are not four corners of a convex quadrilateral inside the picture.
    """
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    text = " ".join(f"{x:g},{y:g}" for x, y in points)
    if len(points) != 4 or not np.all(np.isfinite(points)):
        raise CalibrationError(f"--corners '{text}': give four points, 'x,y x,y x,y x,y'")
    width, height = image_size
    if np.any(points < -0.5) or np.any(points > (width - 0.5, height - 0.5)):
        raise CalibrationError(
            f"--corners '{text}': all must lie inside the photo ({width}x{height} pixels)"
        )
    middle = points.mean(axis=0)
    angles = np.arctan2(points[:, 1] - middle[1], points[:, 0] - middle[0])
    ordered = points[np.argsort(angles, kind="stable")]
    ordered = np.roll(ordered, -int(np.argmin(ordered.sum(axis=1))), axis=0)
    along = np.roll(ordered, -1, axis=0) - ordered
    following = np.roll(along, -1, axis=0)
    lengths = np.linalg.norm(along, axis=1)
    if lengths.min() < 2.0:
        raise CalibrationError(
            f"--corners '{text}': two corners are the same point; give four different ones"
        )
    turn = along[:, 0] * following[:, 1] - along[:, 1] * following[:, 0]
    if np.any(turn < 0.01 * lengths * np.roll(lengths, -1)):
        raise CalibrationError(
            f"--corners '{text}': three lie on one line, or one lies inside the others; "
            "give the four corners of the square"
        )
    return ordered


def fit_homography(target: Float64Array, pixels: Float64Array) -> Float64Array:
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
    result: Float64Array = homography / np.linalg.norm(homography)
    return result


def focal_from_homography(centred_from_target: Float64Array, width_pixels: float) -> float | None:
    """Return the focal length, pixels, in closed form, or None where it is not observable.

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
    (h1x^2 + h1y^2 - h2x^2 - h2y^2) w + h1z^2 - h2z^2 = 0. Both together, by least squares, serve
    a square at any angle; a square seen straight on leaves only the second, a camera that
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


def squareness(
    corners: Float64Array,
    image_size: tuple[int, int],
    intrinsics: Intrinsics | None,
    tolerance_pixels: float,
) -> float:
    """Return how well four corners may be a square on the floor before a robot, in [0, 1].

    For each focal length that a camera may have (or the one that is known) the corners' two floor
    directions should be perpendicular and equally long; the best counts, times how plausible
    its pitch and roll are. A wall's rectangle looks like a floor seen from straight
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
        column, row = image_centre(image_size)
        low, high = FOCAL_RANGE_WIDTHS
        centring = np.array([[1.0, 0.0, -column], [0.0, 1.0, -row], [0.0, 0.0, 1.0]])
        closed_form = focal_from_homography(centring @ homography, float(image_size[0]))
        focals = [*(image_size[0] * np.geomspace(low, high, _SEARCH_STEPS))]
        focals += [] if closed_form is None else [closed_form]
        matrices = [np.array([[f, 0, column], [0, f, row], [0, 0, 1.0]]) for f in focals]
    else:
        matrices = [intrinsics.camera_matrix]
    # Seen at a grazing angle a square is flat in the picture, and a pixel up or down matters more.
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
        up, _ = floor_axes(columns)
        pitch, roll = tilt(up)
        fit = math.exp(-0.5 * (skew**2 + stretch**2) / tolerance**2)
        best = max(best, fit * _plausible(pitch, roll))
    return best


def floor_axes(columns: Float64Array) -> tuple[Float64Array, float]:
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


def _plausible(pitch_radians: float, roll_radians: float) -> float:
    """Return how plausible a mounting is, in [0, 1]: most look ahead, pitch 5 to 65 degrees, level.

    One that looks about straight down, where the roll means nothing, or that is rolled by quarter
    turns, is as likely as this says where no other square is seen.
    """
    pitch, roll = math.degrees(pitch_radians), math.degrees(roll_radians)
    level = math.exp(-0.5 * (max(5.0 - pitch, pitch - 75.0, 0.0) / 6.0) ** 2)
    usual = level * math.exp(-0.5 * (roll / 15.0) ** 2)
    rolled = level * math.exp(-0.5 * (math.remainder(roll, 90.0) / 15.0) ** 2)
    steep = math.exp(-0.5 * (max(75.0 - pitch, 0.0) / 6.0) ** 2)
    return max(usual, _UNUSUAL_SHARE * max(rolled, steep))


def _normalising(points: Float64Array) -> Float64Array:
    """Return the (3, 3) similarity that centres points and brings them to unit spread."""
    middle = points.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1))))
    scale = math.sqrt(2.0) / max(spread, 1e-12)
    return np.array(
        [[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]], [0.0, 0.0, 1.0]]
    )
