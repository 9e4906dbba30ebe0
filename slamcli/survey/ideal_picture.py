"""The picture that an ideal camera would have taken, made of one of a known lens.

Without distortion, with square pixels and the principal point in the middle, a plane seen twice is
one homography. Another turns a camera that looks ahead into one that looks straight down from the
same place.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration, Intrinsics
from slamcli.core.camera.lens import distort_points, image_centre
from slamcli.core.camera.mounting import robot_from_camera_rotation
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.geometry import apply_homography

# The axes of a camera that looks straight down, its picture's up ahead, in the robot frame: its
# right, down and ahead are columns.
_ROBOT_FROM_NADIR = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class IdealPicture:
    """How pictures of one camera are made ideal.

    Attributes
    ----------
    columns, rows : (H, W) float32
        Where each pixel of the ideal picture is in the camera's own.
    usable : (H, W) uint8
        255 where the ideal picture shows floor within range.
    """

    columns: Float32Array
    rows: Float32Array
    usable: UInt8Array

    def of(self, gray: UInt8Array, mask: UInt8Array | None) -> tuple[UInt8Array, UInt8Array]:
        """Return the ideal picture and its mask, (H, W) uint8 each."""
        picture = cv2.remap(gray, self.columns, self.rows, cv2.INTER_LINEAR)
        seen = self.usable
        if mask is not None:
            seen = np.minimum(seen, cv2.remap(mask, self.columns, self.rows, cv2.INTER_NEAREST))
        return np.asarray(picture, np.uint8), np.asarray(seen, np.uint8)


def ideal_picture(lens: Calibration | Intrinsics) -> IdealPicture:
    """Return how pictures of a camera are made ideal, at its own focal length and size."""
    width, height = lens.image_size
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    from_middle = (pixels - image_centre(lens.image_size)) / focal_pixels(lens)
    own = distort_points(lens, apply_homography(lens.camera_matrix, from_middle))
    read = own.astype(np.float32).reshape(height, width, 2)
    across, down = np.ascontiguousarray(read[..., 0]), np.ascontiguousarray(read[..., 1])
    usable = np.full((height, width), 255, np.uint8)
    if isinstance(lens, Calibration) and not lens.is_top_down:
        usable = np.where(resolution_image(lens) > 0.0, np.uint8(255), np.uint8(0))
    seen = cv2.remap(usable, across, down, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return IdealPicture(across, down, np.asarray(seen, np.uint8))


def focal_pixels(lens: Calibration | Intrinsics) -> float:
    """Return the focal length of a camera's ideal pictures."""
    return float(lens.camera_matrix[0, 0])


def camera_from_nadir_rotation(calibration: Calibration) -> Float64Array:
    """Return the (3, 3) rotation to a camera's axes from those of one that looks straight down.

    The picture's up of that one points ahead.
    """
    robot_from_camera = robot_from_camera_rotation(
        calibration.pitch_radians, calibration.roll_radians, calibration.ahead_radians
    )
    return np.asarray(robot_from_camera.T @ _ROBOT_FROM_NADIR, np.float64)


def camera_from_nadir(calibration: Calibration) -> Float64Array:
    """Return the (3, 3) homography between pixels from the middles of both cameras' pictures."""
    focal = focal_pixels(calibration)
    to_pixels = np.diag([focal, focal, 1.0])
    rotation = camera_from_nadir_rotation(calibration)
    return np.asarray(to_pixels @ rotation @ np.diag([1.0 / focal, 1.0 / focal, 1.0]), np.float64)
