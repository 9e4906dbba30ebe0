"""Photographs of a simulated world, with what makes real ones worse than ideal ones.

A floor made in light is photographed by a whole camera (`imaging`); one made of
encoded gray levels, as worlds were at first, is blended in these, with plain noise on top.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Pose2
from slamcli.core.light import light_of_gray
from slamcli.simulation.config import DisturbanceOptions, ImagingOptions
from slamcli.simulation.photograph import imaging
from slamcli.simulation.photograph.boxes import draw_boxes
from slamcli.simulation.photograph.camera import tilted
from slamcli.simulation.photograph.render import Renderer, Shutter
from slamcli.simulation.photograph.world import World

_BLUR_POSES = 5


class Photographer:
    """Takes pictures of a world with one camera.

    Parameters
    ----------
    world : World
    calibration : Calibration
        The true one.
    options : ImagingOptions
        Of a world in light.
    seed : int
        Of what stays the same in all pictures: dust on the glass.
    """

    def __init__(
        self,
        world: World,
        calibration: Calibration,
        options: ImagingOptions | None = None,
        seed: int = 0,
    ) -> None:
        self.calibration = calibration
        self.options = options or ImagingOptions()
        self.in_light = world.floor.in_light
        self._boxes = world.boxes
        if self.in_light:
            decals = [replace(d, gray=light_of_gray(d.gray)) for d in world.decals]
            self._boxes = tuple(
                replace(box, colour=tuple(map(light_of_gray, box.colour)))  # type: ignore[arg-type]
                for box in world.boxes
            )
            world = replace(world, decals=tuple(decals))
        self._renderer = Renderer(world, calibration)
        self._sensors: dict[float, imaging.Sensor] = {}
        self._seed = seed

    def expose(self, shutter: Shutter, calibration: Calibration, stamp: float) -> Float32Array:
        """Return (H, W, 3) float32 BGR of one instant, or one roll of the shutter, without noise.

        Light from 0 to 255 (white) where the world is made in light, else encoded gray levels.
        """
        image = self._renderer.render(shutter, calibration)
        draw_boxes(image, self._boxes, shutter.first, calibration, stamp)
        return image

    def develop(
        self,
        light: Float32Array,
        gain: float,
        disturbances: DisturbanceOptions,
        generator: np.random.Generator,
    ) -> UInt8Array:
        """Return the 8-bit picture that the camera writes."""
        if self.in_light:
            return self._sensor(disturbances.vignetting).develop(
                light, gain, disturbances.noise_gray, generator
            )
        noise = generator.standard_normal(light.shape[:2], dtype=np.float32)[..., None]
        fixed = imaging.vignetting_image(self.calibration.image_size, disturbances.vignetting)
        image = light * np.float32(gain) * fixed + disturbances.noise_gray * noise
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def _sensor(self, vignetting: float) -> imaging.Sensor:
        if vignetting not in self._sensors:
            self._sensors[vignetting] = imaging.Sensor(
                self.calibration.image_size, self.options, vignetting, self._seed
            )
        return self._sensors[vignetting]


def take(
    photographer: Photographer,
    way: tuple[Pose2, Pose2],
    stamp: float,
    disturbances: DisturbanceOptions,
    generator: np.random.Generator,
) -> UInt8Array:
    """Return one frame (H, W, 3) uint8 BGR.

    Parameters
    ----------
    way : (Pose2, Pose2)
        world_from_robot of this frame and of the next, between which the shutter is open.
    stamp : float
        Seconds.
    generator : Generator
        Of this frame alone, so that frames can be taken in any order.
    """
    rocking = math.radians(disturbances.rocking_degrees) * generator.standard_normal(2)
    bounce = disturbances.bounce_metres * generator.standard_normal()
    gain = 1.0 + disturbances.flicker * generator.uniform(-1.0, 1.0)
    calibration = tilted(
        photographer.calibration, float(rocking[0]), float(rocking[1]), float(bounce)
    )
    start, end = way
    motion = start.inverse() @ end
    rolled = photographer.options.rolling_shutter if photographer.in_light else 0.0
    count = _BLUR_POSES if disturbances.motion_blur > 0 else 1
    exposures = []
    for number in range(count):
        share = disturbances.motion_blur * (number / max(1, count - 1) - 0.5)
        first = start @ _part(motion, share)
        last = first if rolled == 0.0 else first @ _part(motion, rolled)
        exposures.append(photographer.expose(Shutter(first, last), calibration, stamp))
    light = exposures[0] if count == 1 else np.asarray(np.mean(exposures, axis=0), np.float32)
    return photographer.develop(light, gain, disturbances, generator)


def _part(motion: Pose2, share: float) -> Pose2:
    return Pose2(share * motion.x, share * motion.y, share * motion.theta)
