"""A camera over a flat floor: its lens, and where it is mounted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import invert

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
Unit = Literal["m", "px"]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A camera over a flat floor.

    The robot frame lies on the floor straight below the camera: x ahead (the floor projection of
    the optical axis), y left, z up (ROS REP 103).

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
        About the optical axis: positive lowers the camera's right side.
    max_range_metres : float
        Distance on the floor from the robot's origin beyond which the image is not used.
    focal_sigma_pixels, height_sigma_metres, pitch_sigma_radians, roll_sigma_radians : float
        One standard deviation of each; nan where it is not known.
    unit : str
        ``m``, or ``px`` for top-down frames without a calibration, where every "metre" is a pixel
        and height, pitch and roll are nan.
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
    unit: Unit = "m"

    @property
    def image_from_robot(self) -> Float64Array:
        """(3, 3): floor metres to undistorted pixel; w > 0 in front of the camera."""
        return invert(self.robot_from_image)


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
    """By how much the camera of one frame stood differently from the calibration.

    Attributes
    ----------
    pitch_radians, roll_radians : float
    height_metres : float
    """

    pitch_radians: float = 0.0
    roll_radians: float = 0.0
    height_metres: float = 0.0
