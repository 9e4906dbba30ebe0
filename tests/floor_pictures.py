"""FrameCache of an asphalt-like floor with known motions between them, for tests."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import View

SIDE = 600


def asphalt(side_pixels: int, seed: int = 0) -> NDArray[np.uint8]:
    """Noise of many grain sizes, without structure that a detector could lean on."""
    generator = np.random.default_rng(seed)
    texture = np.full((side_pixels, side_pixels), 128.0, np.float32)
    for sigma, gray in ((1.2, 14.0), (2.5, 12.0), (5.0, 8.0), (12.0, 4.0)):
        noise = generator.standard_normal(texture.shape, np.float32)
        grain = cv2.GaussianBlur(noise, (0, 0), sigma)
        texture += gray * grain / grain.std()
    return np.clip(texture, 0, 255).astype(np.uint8)


def square_grid(side: int = SIDE) -> Grid:
    """One metre a pixel, the origin in the middle."""
    return Grid(-side / 2, side / 2, 1.0, side, side)


def look(
    floor: NDArray[np.uint8], map_from_robot: Pose2, noise: float = 2.0, seed: int = 0
) -> View:
    """Look straight down on a floor whose pixels are its metres, origin in its middle."""
    grid = square_grid()
    floor_grid = square_grid(floor.shape[0])
    homography = floor_grid.pixel_from_metres @ map_from_robot.matrix @ grid.metres_from_pixel
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    seen = cv2.warpPerspective(floor, homography, (SIDE, SIDE), flags=flags).astype(np.float64)
    seen += np.random.default_rng(seed).normal(0.0, noise, seen.shape)
    image = np.clip(np.rint(seen), 0, 255).astype(np.uint8)
    return View(grid, image, np.full(image.shape, 255, np.uint8))


def top_down() -> Calibration:
    """The stand-in for pixel units."""
    return top_down_calibration((SIDE, SIDE))


def forward_camera() -> Calibration:
    """A 640x480 camera 0.3 m above the floor, looking 45 degrees down."""
    matrix = np.array([[520.0, 0.0, 319.5], [0.0, 520.0, 239.5], [0.0, 0.0, 1.0]])
    pitch = math.radians(45.0)
    return Calibration(
        camera_matrix=matrix,
        distortion=np.zeros(5),
        distortion_model="plumb_bob",
        image_size=(640, 480),
        robot_from_image=compose_robot_from_image(matrix, 0.3, pitch, 0.0),
        height_metres=0.3,
        pitch_radians=pitch,
        roll_radians=0.0,
        max_range_metres=0.9,
    )


def photograph(
    floor: NDArray[np.uint8], floor_grid: Grid, calibration: Calibration, map_from_robot: Pose2
) -> NDArray[np.uint8]:
    """Take the forward camera's BGR picture of a floor from a pose on it."""
    floor_from_image = (
        floor_grid.pixel_from_metres @ map_from_robot.matrix @ calibration.robot_from_image
    )
    # Twice the pixels, then a box: each pixel of a camera gathers light over its own area.
    halves = Grid(0.0, 0.0, 0.5, 1, 1).metres_from_pixel
    image_from_fine = Grid(0.0, 0.0, 1.0, 1, 1).pixel_from_metres @ halves
    width, height = calibration.image_size
    fine = cv2.warpPerspective(
        floor,
        floor_from_image @ image_from_fine,
        (2 * width, 2 * height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    seen = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(seen, cv2.COLOR_GRAY2BGR), np.uint8)
