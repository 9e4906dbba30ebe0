"""A simulated frame: motion blur, rocking, flicker, vignetting and noise."""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.lens import image_centre
from slamcli.core.geometry import Pose2
from slamcli.simulation.config import DisturbanceOptions
from slamcli.simulation.photograph.camera import tilted
from slamcli.simulation.photograph.render import Photographer

# Motion blur is the mean of the images at this many poses.
_BLUR_POSES = 5


def take(
    photographer: Photographer,
    shutter_poses: tuple[Pose2, Pose2],
    stamp: float,
    disturbances: DisturbanceOptions,
    generator: np.random.Generator,
) -> UInt8Array:
    """Return one frame (H, W, 3) uint8 BGR.

    Parameters
    ----------
    shutter_poses : (Pose2, Pose2)
        world_from_robot of this frame and of the next, between which the shutter is open.
    stamp : float
        Seconds.
    generator : Generator
        Of this frame alone, so that frames can be rendered in any order.
    """
    rocking = math.radians(disturbances.rocking_degrees) * generator.standard_normal(2)
    bounce = disturbances.bounce_metres * generator.standard_normal()
    gain = 1.0 + disturbances.flicker * generator.uniform(-1.0, 1.0)
    calibration = tilted(
        photographer.calibration, float(rocking[0]), float(rocking[1]), float(bounce)
    )
    start, end = shutter_poses
    motion = start.inverse() @ end
    count = _BLUR_POSES if disturbances.motion_blur > 0 else 1
    total = np.zeros((*calibration.image_size[::-1], 3), np.float32)
    for number in range(count):
        share = disturbances.motion_blur * (number / max(1, count - 1) - 0.5)
        moved = start @ Pose2(share * motion.x, share * motion.y, share * motion.theta)
        total += photographer.expose(moved, calibration, stamp)
    image = total * np.float32(gain / count) * _vignette(calibration, disturbances.vignetting)
    image = (
        image
        + disturbances.noise_gray
        * generator.standard_normal(image.shape[:2], dtype=np.float32)[..., None]
    )
    return np.asarray(np.clip(np.round(image), 0, 255), np.uint8)


def _vignette(calibration: Calibration, share: float) -> Float32Array:
    """Return (H, W, 1): the brightness lost towards the corners, by the square of the radius."""
    width, height = calibration.image_size
    centre_x, centre_y = image_centre(calibration.image_size)
    x, y = np.meshgrid(np.arange(width) - centre_x, np.arange(height) - centre_y)
    radius_squared = (x * x + y * y) / (centre_x**2 + centre_y**2)
    return np.asarray(1.0 - share * radius_squared, np.float32)[..., None]
