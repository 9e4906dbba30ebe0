"""An oblique camera found without a calibration: what it is, and whether it is determined."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import choose_max_range
from slamcli.core.camera.lens import image_centre
from slamcli.core.camera.mounting import compose_robot_from_image, image_from_robot_homography

# Sigmas of the priors of log focal length in widths of the picture, of roll, and of k1.
FOCAL_PRIOR_SIGMA, ROLL_PRIOR_SIGMA, BEND_PRIOR_SIGMA = 0.7, math.radians(10.0), 0.1
# Sigma of the logarithm of a focal length that photos note: of whole millimetres of a film, and of
# the crop of a video's frames.
NOTED_FOCAL_SIGMA = 0.05
# Of one that is known.
KNOWN_FOCAL_SIGMA = 1e-3
# Of an observable camera: sigmas of log focal length, that of a note at most, and of the pitch
# [benchmarks/free_cameras.py: a straight line has 0.057 and is 0.065 off, oblique cameras that turn
# 0.0001; five rendered frames over lines 0.004].
_MAX_FOCAL_SIGMA = NOTED_FOCAL_SIGMA
_MAX_PITCH_SIGMA, _MAX_PITCH = math.radians(2.0), math.radians(70.0)


@dataclass(frozen=True, slots=True, eq=False)
class ObliqueCamera:
    """What the motions of the floor determine of a camera.

    Attributes
    ----------
    focal_pixels : float
    pitch_radians, roll_radians : float
        As in `Calibration`.
    k1 : float
        Radial distortion, in OpenCV's model.
    focal_sigma, pitch_sigma : float
        Of the logarithm; radians.
    median_pixels : float
        Of the residuals.
    reason : str
        Why the camera is not determined; empty when it is.
    """

    focal_pixels: float
    pitch_radians: float
    roll_radians: float
    k1: float
    focal_sigma: float
    pitch_sigma: float
    median_pixels: float
    reason: str = ""

    @property
    def steep(self) -> bool:
        """Whether the camera may as well look straight down."""
        return not self.pitch_radians < _MAX_PITCH

    def checked(self) -> ObliqueCamera:
        """Return the camera, with the reason when it is not determined or not plausible."""
        if self.focal_sigma > _MAX_FOCAL_SIGMA or self.pitch_sigma > _MAX_PITCH_SIGMA:
            reason = (
                f"the frames do not determine the focal length (±{self.focal_sigma:.0%}) and the "
                f"pitch (±{math.degrees(self.pitch_sigma):.1g}°): let the camera turn on its way"
            )
        elif not 0.0 < self.pitch_radians < _MAX_PITCH:
            reason = f"its pitch of {math.degrees(self.pitch_radians):.0f}° is not plausible"
        else:
            return self
        return replace(self, reason=reason)

    def calibration(self, size: tuple[int, int], height_metres: float | None) -> Calibration:
        """Return the calibration of pictures of `size`; without a height, that is the unit."""
        column, row = image_centre(size)
        focal, height = self.focal_pixels, height_metres or 1.0
        matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
        mounting = (height, self.pitch_radians, self.roll_radians)
        image_from_robot = image_from_robot_homography(matrix, *mounting)
        return Calibration(
            camera_matrix=matrix,
            distortion=np.array([self.k1, 0.0, 0.0, 0.0, 0.0]),
            distortion_model="plumb_bob",
            image_size=size,
            robot_from_image=compose_robot_from_image(matrix, *mounting),
            height_metres=height,
            pitch_radians=self.pitch_radians,
            roll_radians=self.roll_radians,
            max_range_metres=choose_max_range(matrix, image_from_robot, size),
            focal_sigma_pixels=self.focal_sigma * focal,
            pitch_sigma_radians=self.pitch_sigma,
            unit="m" if height_metres else "h",
        )


def undistorted(pixels: Float64Array, k1: float, focal: float) -> Float64Array:
    """Return (N, 2) undistorted pixels from the picture's middle, by the fixed-point iteration."""
    found = pixels
    for _ in range(4):
        squares = np.sum((found / focal) ** 2, axis=1)
        found = pixels / np.clip(1.0 + k1 * squares, 0.3, 3.0)[:, None]
    return found


def distorted(pixels: Float64Array, k1: float, focal: float) -> Float64Array:
    """Return (N, 2) distorted pixels from the picture's middle."""
    factor = 1.0 + k1 * np.sum((pixels / focal) ** 2, axis=1)
    return np.asarray(pixels * factor[:, None], np.float64)
