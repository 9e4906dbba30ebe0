"""The footprint: which floor the camera sees within its range, and at which resolution."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import CACHED_CALIBRATIONS, Calibration
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.projection import project_floor
from slamcli.core.camera.resolution import floor_sampling, resolution_image
from slamcli.core.errors import CalibrationError, InputError
from slamcli.core.geometry import Grid, apply_homography, invert

# Beyond this multiple of the sampling at the near edge a pixel covers too much floor: a patch no
# longer looks like itself from one step nearer [guarded by benchmarks/accuracy.py].
FAR_TO_NEAR_SAMPLING_RATIO = 12.0
# The narrower side of a view has at least as many, unless the picture itself has fewer.
_MIN_VIEW_PIXELS = 8
# Of a view that is registered: more takes gigabytes and minutes, and is no better.
MAX_REGISTRATION_PIXELS = 2**24
_ROUND_STEPS = (1.0, 2.0, 5.0, 10.0)
# Views are compared pixel by pixel with half to a quarter of the pixels that features are detected
# in, a quarter of what the camera saw at most: that already resolves hundredths of a pixel
# [benchmarks/accuracy.py, benchmarks/streaming.py].
_LEAST_COARSER, _COARSER = 1.45, 2.0


@lru_cache(maxsize=CACHED_CALIBRATIONS)
def seen_floor(calibration: Calibration) -> Float64Array:
    """Return (N, 2) floor points, metres, that fill the usable region about evenly in the picture.

    Read-only, as it is computed once for each calibration.

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
    floor.setflags(write=False)
    return floor


@lru_cache(maxsize=CACHED_CALIBRATIONS)
def footprint_hull(calibration: Calibration) -> Float64Array:
    """Return the (N, 2) convex outline, metres in the robot frame, of the usable floor.

    Read-only, as it is computed once for each calibration.
    """
    floor = seen_floor(calibration)
    # The lattice of seen_floor stops short of the far limit; rays at that limit close the gap.
    bearings = np.linspace(-math.pi, math.pi, 1441)
    far = calibration.max_range_metres * np.column_stack([np.cos(bearings), np.sin(bearings)])
    _, seen = project_floor(calibration, far * (1.0 - 1e-9))
    points = np.vstack([floor, far[seen]])
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError as error:
        raise CalibrationError(
            "the floor that the calibration sees has no area; calibrate again"
        ) from error
    hull.setflags(write=False)
    return hull


def footprint(calibration: Calibration, metres_per_pixel: float) -> Grid:
    """Return the smallest grid in the robot frame that covers the usable floor."""
    return Grid.covering(footprint_hull(calibration), metres_per_pixel)


def compared_metres_per_pixel(calibration: Calibration, metres_per_pixel: float) -> float:
    """Return the resolution at which views are compared by their pixels.

    Parameters
    ----------
    calibration : Calibration
    metres_per_pixel : float
        Of the views that features are detected in.
    """
    seen = _COARSER * default_metres_per_pixel(calibration)
    return min(_COARSER * metres_per_pixel, max(_LEAST_COARSER * metres_per_pixel, seen))


def compared_grid(calibration: Calibration, metres_per_pixel: float) -> Grid:
    """Return the grid of the views that are compared, given the resolution of the features'."""
    return footprint(calibration, compared_metres_per_pixel(calibration, metres_per_pixel))


def check_metres_per_pixel(
    calibration: Calibration,
    metres_per_pixel: float,
    max_pixels: int,
    option: str = "--metres-per-pixel",
) -> None:
    """Refuse a resolution at which one view would have next to no pixels, or far too many.

    Parameters
    ----------
    max_pixels : int
    option : str
        By which a user chooses it.

    Raises
    ------
    InputError
        With the resolutions that serve.
    """
    width, height = np.ptp(footprint_hull(calibration), axis=0)
    coarsest = max(
        default_metres_per_pixel(calibration), float(min(width, height)) / _MIN_VIEW_PIXELS
    )
    finest = math.sqrt(float(width) * float(height) / max_pixels)
    if not finest <= metres_per_pixel <= coarsest:
        unit = calibration.unit
        raise InputError(
            f"a view of {width:.3g} x {height:.3g} {unit} cannot be made with pixels of "
            f"{metres_per_pixel:g} {unit}; give {option} from {finest:.2g} to "
            f"{coarsest:.2g}"
        )


@lru_cache(maxsize=CACHED_CALIBRATIONS)
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


def choose_max_range(
    camera_matrix: Float64Array,
    image_from_robot: Float64Array,
    image_size: tuple[int, int],
) -> float:
    """Return the far limit, metres: where one pixel covers too much floor to be of use.

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
