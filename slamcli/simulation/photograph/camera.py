"""The simulated camera: its true calibration, its texture resolution, and its rocking."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import choose_max_range, seen_floor
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.mounting import compose_robot_from_image, image_from_robot_homography
from slamcli.core.camera.resolution import floor_sampling
from slamcli.simulation.config import CameraOptions

_FINEST_METRES_PER_PIXEL, _COARSEST_METRES_PER_PIXEL = 0.00025, 0.001


def make_camera(options: CameraOptions) -> Calibration:
    """Return the true calibration of a simulated camera."""
    focal = options.size[0] / 2 / math.tan(math.radians(options.field_of_view_degrees) / 2)
    centre_x, centre_y = image_centre(options.size)
    matrix = np.array([[focal, 0.0, centre_x], [0.0, focal, centre_y], [0.0, 0.0, 1.0]])
    pitch, roll = math.radians(options.pitch_degrees), math.radians(options.roll_degrees)
    # Straight down, a roll about the optical axis would be a turn, and no tilt.
    ahead = 0.0 if options.pitch_degrees == 90.0 else math.nan
    mounting = options.height_metres, pitch, roll, ahead
    image_from_robot = image_from_robot_homography(matrix, *mounting)
    return Calibration(
        camera_matrix=matrix,
        distortion=np.array([options.k1, options.k2, 0.0, 0.0, 0.0]),
        distortion_model="plumb_bob",
        image_size=options.size,
        robot_from_image=compose_robot_from_image(matrix, *mounting),
        height_metres=options.height_metres,
        pitch_radians=pitch,
        roll_radians=roll,
        ahead_radians=ahead,
        max_range_metres=choose_max_range(matrix, image_from_robot, options.size),
    )


def texture_metres_per_pixel(calibration: Calibration) -> float:
    """Return the resolution of the floor's texture that matches the near edge of the view."""
    nearest = floor_sampling(calibration, seen_floor(calibration))[:, 1].min()
    finest = _FINEST_METRES_PER_PIXEL
    fitting = float(finest * 2.0 ** round(math.log2(float(nearest) / finest)))
    return min(max(fitting, finest), _COARSEST_METRES_PER_PIXEL)


def tilted(
    calibration: Calibration, pitch_radians: float, roll_radians: float, height_metres: float
) -> Calibration:
    """Return the camera turned and lifted by small amounts, as the robot rocks."""
    height = calibration.height_metres + height_metres
    pitch = calibration.pitch_radians + pitch_radians
    roll = calibration.roll_radians + roll_radians
    return replace(
        calibration,
        robot_from_image=compose_robot_from_image(
            calibration.camera_matrix, height, pitch, roll, calibration.ahead_radians
        ),
        height_metres=height,
        pitch_radians=pitch,
        roll_radians=roll,
    )
