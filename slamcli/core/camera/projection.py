"""The camera over the floor: projection both ways, lens distortion, and how finely it sees.

Pinhole model and distortion polynomials as in ROS camera_info / OpenCV: ``plumb_bob`` and
``rational_polynomial`` are Brown-Conrady, ``equidistant`` is Kannala-Brandt (fisheye).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.camera.mounting import compose_robot_from_image as compose_robot_from_image
from slamcli.core.camera.mounting import image_from_robot_homography as image_from_robot_homography
from slamcli.core.camera.mounting import robot_from_camera_rotation as robot_from_camera_rotation
from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import Grid, Pose2, apply_homography, invert

# Beyond this multiple of the sampling at the near edge, a pixel smears so much floor that a patch
# no longer looks like itself from one step nearer.
FAR_TO_NEAR_SAMPLING_RATIO = 12.0
# A sampling of the image's border fine enough that its floor outline is smooth.
_OUTLINE_POINTS_PER_SIDE = 48
# Lens distortion is this smooth: a point in four pixels is enough to interpolate between.
_LATTICE_PIXELS = 4
# So much farther than the range a picture's pixels are kept until their exact place is known.
_RANGE_MARGIN = 1.05
_ROUND_STEPS = (1.0, 2.0, 5.0, 10.0)

Lens = Calibration | Intrinsics


def image_centre(image_size: tuple[int, int]) -> tuple[float, float]:
    """Return the (column, row) of a picture's middle, where a pixel's centre is a whole number."""
    width, height = image_size
    return (width - 1) / 2, (height - 1) / 2


def top_down_calibration(image_size: tuple[int, int]) -> Calibration:
    """Return the stand-in for frames taken straight down, in pixel units.

    The robot frame has its origin at the image's centre, x to the right and y up.
    """
    width, height = image_size
    centre = Grid(0.0, 0.0, 1.0, width, height).pixel_from_metres @ (width / 2, -height / 2, 1.0)
    robot_from_image = np.array([[1.0, 0.0, -centre[0]], [0.0, -1.0, centre[1]], [0.0, 0.0, 1.0]])
    return Calibration(
        camera_matrix=np.array(
            [[max(image_size), 0.0, centre[0]], [0.0, max(image_size), centre[1]], [0.0, 0.0, 1.0]]
        ),
        distortion=np.zeros(5),
        distortion_model="plumb_bob",
        image_size=image_size,
        robot_from_image=robot_from_image,
        height_metres=math.nan,
        pitch_radians=math.nan,
        roll_radians=math.nan,
        max_range_metres=math.hypot(width, height),
        unit="px",
    )


def undistort_points(calibration: Lens, pixels: ArrayLike) -> Float64Array:
    """Map (N, 2) pixels of the camera's own picture to (N, 2) undistorted pixels."""
    points = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0 or not np.any(calibration.distortion):
        return points.copy()
    matrix, distortion = calibration.camera_matrix, calibration.distortion
    # OpenCV's iteration stops early by default; a camera model has to invert to well below a pixel.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    if calibration.distortion_model == "equidistant":
        mapped = cv2.fisheye.undistortPoints(
            points[:, None], matrix, distortion[:4], P=matrix, criteria=criteria
        )
    else:
        mapped = cv2.undistortPoints(
            points[:, None], matrix, distortion, P=matrix, criteria=criteria
        )
    return np.asarray(mapped, dtype=np.float64).reshape(-1, 2)


def distort_points(calibration: Lens, pixels: ArrayLike) -> Float64Array:
    """Map (N, 2) undistorted pixels to (N, 2) pixels of the camera's own picture."""
    points = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    if len(points) == 0 or not np.any(calibration.distortion):
        return points.copy()
    matrix, distortion = calibration.camera_matrix, calibration.distortion
    normalised = apply_homography(invert(matrix), points)
    if calibration.distortion_model == "equidistant":
        mapped = cv2.fisheye.distortPoints(normalised[:, None], matrix, distortion[:4])
    else:
        rays = np.column_stack([normalised, np.ones(len(normalised))])
        mapped, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, distortion)
    return np.asarray(mapped, dtype=np.float64).reshape(-1, 2)


def project_floor(calibration: Calibration, points: ArrayLike) -> tuple[Float64Array, BoolArray]:
    """Project floor points into the camera's own picture.

    Parameters
    ----------
    points : (N, 2) array, metres, robot frame

    Returns
    -------
    pixels : (N, 2) array
        Meaningful only where seen.
    seen : (N,) bool
        In front of the camera, inside the picture, within the calibration's range.
    """
    floor = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    depth = floor @ calibration.image_from_robot[2, :2] + calibration.image_from_robot[2, 2]
    in_front = depth > 0.0
    undistorted = np.full_like(floor, np.nan)
    undistorted[in_front] = apply_homography(calibration.image_from_robot, floor[in_front])
    low, high = undistorted_bounds(calibration)
    # Outside the undistorted picture the lens polynomial may fold back into it.
    in_bounds = in_front & np.all((undistorted >= low) & (undistorted <= high), axis=1)
    pixels = np.full_like(floor, np.nan)
    pixels[in_bounds] = distort_points(calibration, undistorted[in_bounds])
    width, height = calibration.image_size
    seen = in_bounds & (np.hypot(floor[:, 0], floor[:, 1]) <= calibration.max_range_metres)
    seen[seen] = np.all((pixels[seen] >= 0) & (pixels[seen] <= (width - 1, height - 1)), axis=1)
    return pixels, seen


def floor_sampling(calibration: Calibration, points: ArrayLike) -> Float64Array:
    """Return how many metres of floor one pixel covers at (N, 2) points in the robot frame.

    Returns
    -------
    (N, 2) array, metres per pixel: along the line of sight on the floor, and across it; from the
    Jacobian of the floor homography (lens distortion is left out: it changes this by little).
    """
    floor = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    homography = calibration.image_from_robot
    denominator = floor @ homography[2, :2] + homography[2, 2]
    pixels = apply_homography(homography, floor)
    jacobian = (
        homography[None, :2, :2] - pixels[:, :, None] * homography[None, 2:, :2]
    ) / denominator[:, None, None]
    along, across = line_of_sight_axes(floor)
    pixels_per_metre = np.stack(
        [
            np.linalg.norm(np.einsum("nij,nj->ni", jacobian, along), axis=1),
            np.linalg.norm(np.einsum("nij,nj->ni", jacobian, across), axis=1),
        ],
        axis=1,
    )
    sampling: Float64Array = 1.0 / pixels_per_metre
    return sampling


def range_sigma(
    calibration: Calibration, points: ArrayLike, tilt_sigma_radians: float
) -> Float64Array:
    """Return (N,) metres by which floor points shift along the line of sight when the camera tilts.

    A point at distance d, seen from height h under the angle atan(h / d), moves by
    (d^2 + h^2) / h for a radian. Zero where the height is not known.
    """
    floor = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    if not math.isfinite(calibration.height_metres):
        return np.zeros(len(floor))
    squared = np.einsum("ni,ni->n", floor, floor)
    height = calibration.height_metres
    sigma: Float64Array = (squared + height**2) / height * tilt_sigma_radians
    return sigma


def line_of_sight_axes(
    points: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return the unit vectors on the floor along and across the line of sight, each (N, 2)."""
    distance = np.hypot(points[:, 0], points[:, 1])
    straight_below = distance < 1e-12
    along = np.where(
        straight_below[:, None],
        np.array([1.0, 0.0]),
        points / np.where(straight_below, 1.0, distance)[:, None],
    )
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return along, across


def image_outline(image_size: tuple[int, int]) -> Float64Array:
    """Return (4 n, 2) pixels around the picture's border, clockwise from the upper left."""
    width, height = image_size
    step = np.linspace(0.0, 1.0, _OUTLINE_POINTS_PER_SIDE, endpoint=False)
    zero, one = np.zeros_like(step), np.ones_like(step)
    unit = np.concatenate(
        [
            np.column_stack([step, zero]),
            np.column_stack([one, step]),
            np.column_stack([1.0 - step, one]),
            np.column_stack([zero, 1.0 - step]),
        ]
    )
    outline: Float64Array = unit * (width - 1, height - 1)
    return outline


def seen_floor(calibration: Calibration) -> Float64Array:
    """Return (N, 2) floor points, metres, that fill the usable region about evenly in the picture.

    Raises
    ------
    CalibrationError
        When the camera sees no floor within its range.
    """
    width, height = calibration.image_size
    columns, rows = np.meshgrid(np.linspace(0, width - 1, 65), np.linspace(0, height - 1, 129))
    pixels = undistort_points(calibration, np.column_stack([columns.ravel(), rows.ravel()]))
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    depth_sign = homogeneous @ calibration.robot_from_image[2]
    floor = apply_homography(calibration.robot_from_image, pixels[depth_sign > 0])
    floor = floor[np.hypot(floor[:, 0], floor[:, 1]) <= calibration.max_range_metres]
    if len(floor) < 8:
        raise CalibrationError(
            "the calibration sees no floor within "
            f"{calibration.max_range_metres:.3g} m; calibrate again or raise --max-range"
        )
    return floor


def footprint_hull(calibration: Calibration) -> Float64Array:
    """Return the (N, 2) convex outline, metres in the robot frame, of the usable floor."""
    floor = seen_floor(calibration)
    # The lattice of seen_floor stops short of the far limit; rays at that limit close the gap.
    bearings = np.linspace(-math.pi, math.pi, 1441)
    far = calibration.max_range_metres * np.column_stack([np.cos(bearings), np.sin(bearings)])
    _, seen = project_floor(calibration, far * (1.0 - 1e-9))
    points = np.vstack([floor, far[seen]])
    return points[ConvexHull(points).vertices]


def footprint(calibration: Calibration, metres_per_pixel: float) -> Grid:
    """Return the smallest grid in the robot frame that covers the usable floor."""
    return Grid.covering(footprint_hull(calibration), metres_per_pixel)


def default_metres_per_pixel(calibration: Calibration) -> float:
    """Return a round resolution (1, 2 or 5 times a power of ten) that keeps what the camera saw.

    The largest that gives a bird's-eye view at least as many pixels as the picture spends on it.
    """
    if calibration.unit == "px":
        return 1.0
    hull = ConvexHull(footprint_hull(calibration))
    seen_pixels = np.count_nonzero(resolution_image(calibration))
    typical = math.sqrt(float(hull.volume) / seen_pixels)
    power = 10.0 ** math.floor(math.log10(typical))
    return power * max(step for step in _ROUND_STEPS if step * power <= typical * (1 + 1e-9))


@lru_cache(maxsize=2)
def resolution_image(calibration: Calibration) -> Float32Array:
    """Return (H, W): how many pixels a metre of floor spans, at each pixel of the camera's picture.

    The geometric mean of both directions; 0 where the pixel shows no floor within range, or just
    beyond it: the exact limit is for those who know each pixel's place.
    """
    width, height = calibration.image_size
    columns, rows = np.meshgrid(
        np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    )
    if np.any(calibration.distortion):
        columns, rows = undistorted_coordinates(calibration, columns, rows)
    inverse = calibration.robot_from_image.astype(np.float32)
    x, y, w = (row[0] * columns + row[1] * rows + row[2] for row in inverse)
    reach = np.float32(_RANGE_MARGIN * calibration.max_range_metres)
    seen = (w > 0) & (x * x + y * y <= (reach * w) ** 2)
    # A pixel covers |det H| / w^3 of floor, the Jacobian determinant of the plane map x -> Hx / w.
    determinant = abs(float(np.linalg.det(calibration.robot_from_image)))
    pixels_per_metre = np.zeros((height, width), dtype=np.float32)
    np.sqrt(w**3 / np.float32(determinant), out=pixels_per_metre, where=seen)
    # All who ask are given the same array.
    pixels_per_metre.setflags(write=False)
    return pixels_per_metre


@dataclass(frozen=True, slots=True, eq=False)
class SamplingMap:
    """Where in the camera's own picture each pixel of a floor raster is seen.

    Attributes
    ----------
    columns, rows : (h, w) float32
        In the camera's picture; meaningful only where the resolution is not 0.
    pixels_per_metre : (h, w) float32
        Of the raster given, at those places; 0 where the floor is not seen.
    """

    columns: Float32Array
    rows: Float32Array
    pixels_per_metre: Float32Array


def sampling_map(
    calibration: Calibration,
    pixels_per_metre: Float32Array,
    grid: Grid,
    robot_from_grid: Pose2,
) -> SamplingMap:
    """Project every pixel of a floor raster into the camera's own picture, lens included.

    Parameters
    ----------
    pixels_per_metre : (H, W) float32
        From `resolution_image`, or weights of the same zeros.
    grid : Grid
        In any frame on the floor (the robot's own, or the map).
    robot_from_grid : Pose2
        Where that frame lies for the robot.
    """
    robot_from_pixel = robot_from_grid.matrix @ grid.metres_from_pixel
    homography = calibration.image_from_robot @ robot_from_pixel
    normalised_from_pixel = invert(calibration.camera_matrix) @ homography
    # OpenCV's rectification maps take any plane homography for the "rotation" and apply the lens.
    # Floor behind the camera comes out above the horizon, where the resolution is 0.
    arguments = (invert(normalised_from_pixel), np.eye(3), (grid.width, grid.height))
    if calibration.distortion_model == "equidistant":
        columns, rows = cv2.fisheye.initUndistortRectifyMap(
            calibration.camera_matrix, calibration.distortion[:4], *arguments, cv2.CV_32FC1
        )
    else:
        columns, rows = cv2.initUndistortRectifyMap(
            calibration.camera_matrix, calibration.distortion, *arguments, cv2.CV_32FC1
        )
    sharp = np.asarray(
        cv2.remap(pixels_per_metre, columns, rows, cv2.INTER_LINEAR), dtype=np.float32
    )
    sharp[_out_of_range(calibration, robot_from_pixel, grid)] = 0.0
    if np.any(calibration.distortion):
        # Outside the undistorted picture the lens polynomial may fold back into it.
        sharp[_outside_undistorted(calibration, homography, grid)] = 0.0
    return SamplingMap(np.asarray(columns, np.float32), np.asarray(rows, np.float32), sharp)


def _out_of_range(
    calibration: Calibration, robot_from_pixel: Float64Array, grid: Grid
) -> BoolArray:
    """Return (h, w): whether a raster's pixel lies beyond the range, by its place on the floor."""
    column = np.arange(grid.width, dtype=np.float32)
    row = np.arange(grid.height, dtype=np.float32)
    matrix = robot_from_pixel.astype(np.float32)
    # The squared distance of R p + t is |p|^2 s^2 + 2 t . R p + |t|^2: a sum of row and column.
    scale, offset = grid.metres_per_pixel**2, matrix[:2, 2]
    along = scale * column**2 + 2 * float(offset @ matrix[:2, 0]) * column
    down = scale * row**2 + 2 * float(offset @ matrix[:2, 1]) * row
    limit = np.float32(calibration.max_range_metres**2 - float(offset @ offset))
    beyond: BoolArray = along[None, :] > (limit - down)[:, None]
    return beyond


def _outside_undistorted(
    calibration: Calibration, homography: Float64Array, grid: Grid
) -> BoolArray:
    """Return (h, w): whether a raster's pixel lies outside the undistorted picture."""
    column = np.arange(grid.width, dtype=np.float32)[None, :]
    row = np.arange(grid.height, dtype=np.float32)[:, None]
    x, y, depth = (h[0] * column + h[1] * row + h[2] for h in homography.astype(np.float32))
    low, high = undistorted_bounds(calibration).astype(np.float32)
    inside = (depth > 0) & (x >= low[0] * depth) & (x <= high[0] * depth)
    inside &= (y >= low[1] * depth) & (y <= high[1] * depth)
    outside: BoolArray = ~inside
    return outside


def undistorted_coordinates(
    calibration: Calibration, columns: Float32Array, rows: Float32Array
) -> tuple[Float32Array, Float32Array]:
    """Return the undistorted pixels of many, (h, w) each, that lie within the camera's picture.

    Exact on a lattice of every fourth pixel, interpolated between its points.
    """
    width, height = calibration.image_size
    start = -_LATTICE_PIXELS
    lattice_columns, lattice_rows = np.meshgrid(
        np.arange(start, width + _LATTICE_PIXELS, _LATTICE_PIXELS, dtype=np.float64),
        np.arange(start, height + _LATTICE_PIXELS, _LATTICE_PIXELS, dtype=np.float64),
    )
    lattice = np.column_stack([lattice_columns.ravel(), lattice_rows.ravel()])
    undistorted = undistort_points(calibration, lattice).astype(np.float32)
    field = undistorted.reshape(*lattice_columns.shape, 2)
    scale = np.float32(1.0 / _LATTICE_PIXELS)
    interpolated = cv2.remap(
        field, (columns - start) * scale, (rows - start) * scale, cv2.INTER_LINEAR
    )
    both = np.asarray(interpolated, dtype=np.float32)
    return both[..., 0], both[..., 1]


def choose_max_range(
    camera_matrix: Float64Array,
    image_from_robot: Float64Array,
    image_size: tuple[int, int],
) -> float:
    """Return the distance, metres, at which one pixel covers too much floor to be of use.

    "Features in the distance are distorted beyond recognition" (the 2015 thesis): beyond
    `FAR_TO_NEAR_SAMPLING_RATIO` times the sampling at the near edge, measured along the line of
    sight, a patch is smeared; a camera whose whole picture is better than that keeps all of it.
    """
    probe = Calibration(
        camera_matrix=camera_matrix,
        distortion=np.zeros(5),
        distortion_model="plumb_bob",
        image_size=image_size,
        robot_from_image=invert(image_from_robot),
        height_metres=math.nan,
        pitch_radians=math.nan,
        roll_radians=math.nan,
        max_range_metres=math.inf,
    )
    floor = seen_floor(probe)
    along = floor_sampling(probe, floor)[:, 0]
    usable = along <= FAR_TO_NEAR_SAMPLING_RATIO * along.min()
    return float(np.hypot(floor[usable, 0], floor[usable, 1]).max())


def undistorted_bounds(calibration: Calibration) -> Float64Array:
    """Return (2, 2): lowest and highest undistorted pixel that the picture's border maps to."""
    outline = undistort_points(calibration, image_outline(calibration.image_size))
    margin = 1.0
    return np.array([outline.min(axis=0) - margin, outline.max(axis=0) + margin])
