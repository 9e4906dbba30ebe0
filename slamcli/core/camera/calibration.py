"""The calibration: a camera's lens, and where it is mounted over a flat floor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Grid, invert

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
Unit = Literal["m", "px", "h"]

# Of how many calibrations each thing that follows from one is kept: those of a run, and of the
# frames that are being registered or painted.
CACHED_CALIBRATIONS: Final = 8


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera mounted over a flat floor: its lens, and the homography to the floor.

    The robot frame lies on the floor straight below the camera: x ahead, y left, z up (ROS REP
    103). Ahead is the floor projection of the optical axis, or of a direction in the picture where
    `ahead_radians` gives one, as for a camera that looks about straight down.

    Attributes
    ----------
    camera_matrix : (3, 3) float64, pixels
    distortion : (k,) float64
        Coefficients of `distortion_model`, in ROS camera_info order.
    distortion_model : str
        ``plumb_bob`` (k 4 or 5), ``rational_polynomial`` (k 8) or ``equidistant`` (fisheye, k 4).
    image_size : (int, int)
        Width and height in pixels.
    robot_from_image : (3, 3) float64
        Undistorted pixel (column, row) to floor metres (x, y).
    height_metres : float
        Of the camera's centre above the floor.
    pitch_radians : float
        Of the optical axis below the horizontal: positive looks down.
    roll_radians : float
        About the optical axis or, with `ahead_radians`, about the robot's x axis: positive lowers
        the camera's right side.
    max_range_metres : float
        Distance on the floor from the robot's origin beyond which the image is not used.
    focal_sigma_pixels, height_sigma_metres, pitch_sigma_radians, roll_sigma_radians : float
        One standard deviation of each; nan where it is not known.
    covariance : (4, 4) float64 or None
        Of the logarithms of focal length and height, and of pitch and roll (rad), whose errors make
        up for one another. None where it is not known.
    unit : str
        ``m``; ``h`` for a camera found by its frames alone, where every "metre" is the camera's
        height; or ``px`` for top-down frames without a calibration, where every "metre" is a pixel
        and height, pitch and roll are nan.
    ahead_radians : float
        Direction in the picture that points ahead, clockwise from its up; nan where ahead is the
        optical axis.
    """

    camera_matrix: Float64Array
    distortion: Float64Array
    distortion_model: DistortionModel
    image_size: tuple[int, int]
    robot_from_image: Float64Array
    height_metres: float
    pitch_radians: float
    roll_radians: float
    max_range_metres: float
    focal_sigma_pixels: float = float("nan")
    height_sigma_metres: float = float("nan")
    pitch_sigma_radians: float = float("nan")
    roll_sigma_radians: float = float("nan")
    covariance: Float64Array | None = None
    unit: Unit = "m"
    ahead_radians: float = float("nan")

    @property
    def is_top_down(self) -> bool:
        """Whether the frames are taken straight down, by a camera that was not calibrated."""
        return math.isnan(self.pitch_radians)

    @property
    def image_from_robot(self) -> Float64Array:
        """(3, 3): floor metres to undistorted pixel; w > 0 in front of the camera; read-only."""
        return _image_from_robot(self)


@lru_cache(maxsize=CACHED_CALIBRATIONS)
def _image_from_robot(calibration: Calibration) -> Float64Array:
    inverse = invert(calibration.robot_from_image)
    inverse.setflags(write=False)
    return inverse


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """A camera's lens and sensor, without where it is mounted.

    Attributes
    ----------
    camera_matrix : (3, 3) float64, pixels
    distortion : (k,) float64
        Coefficients of `distortion_model`, in ROS camera_info order.
    distortion_model : str
        As in `Calibration`.
    image_size : (int, int)
        Width and height in pixels.
    """

    camera_matrix: Float64Array
    distortion: Float64Array
    distortion_model: DistortionModel
    image_size: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Rocking:
    """The pitch, roll and height of one frame's camera relative to the calibration.

    Attributes
    ----------
    pitch_radians, roll_radians : float
        Of a top-down frame without a calibration about the picture's horizontal and vertical axis.
    height_metres : float
        Pixels without a calibration.
    """

    pitch_radians: float = 0.0
    roll_radians: float = 0.0
    height_metres: float = 0.0


def top_down_calibration(image_size: tuple[int, int]) -> Calibration:
    """Return the calibration of frames taken straight down without one, in pixel units.

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
