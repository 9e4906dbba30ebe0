"""The camera behind the lens: from light on the sensor to the 8-bit picture that it writes.

Light is on a linear scale on which 255 saturates the sensor. The order is that of a real camera:
optics (blur, vignetting, dust), exposure, a lamp's own pattern, photon and read noise, colour
filter array and demosaicing, sharpening, gamma (sRGB, IEC 61966-2-1), rounding to 8 bits.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.lens import image_centre
from slamcli.core.light import SATURATION, encode
from slamcli.simulation.config import ImagingOptions

# A gray card is exposed to this share of saturation (ISO 2720's mid-tone).
_MID_TONE = 0.18
# Read noise over the photon noise of a full well: 4 electrons beside 65 of some 4,200.
_READ_NOISE_SHARE = 0.06
_SHARPENING_PIXELS = 1.0
_ROWS_AT_A_TIME = 32
# Number of the random stream of what stays the same in all pictures.
_FIXED = 0


class Sensor:
    """Develops pictures of one camera.

    Parameters
    ----------
    image_size : (int, int)
        Width and height in pixels.
    options : ImagingOptions
    vignetting : float
        Share of the light lost in the corners.
    seed : int
        Of what stays the same in all its pictures: dust on the glass.
    """

    def __init__(
        self, image_size: tuple[int, int], options: ImagingOptions, vignetting: float, seed: int
    ) -> None:
        self.options = options
        fixed = vignetting_image(image_size, vignetting) * _lamp_and_dust(image_size, options, seed)
        self._fixed = np.repeat(fixed, 3, axis=2)

    def develop(
        self,
        light: Float32Array,
        gain: float,
        noise_gray: float,
        generator: np.random.Generator,
    ) -> UInt8Array:
        """Return (H, W, 3) uint8 BGR of (H, W, 3) linear light.

        Parameters
        ----------
        light : (H, W, 3) float32, BGR
            Of a scene in which white reflects 255.
        gain : float
            Exposure: how much brighter than as it is.
        noise_gray : float
            Standard deviation of an encoded pixel at the mid-tone, before demosaicing.
        generator : Generator
            Of this picture's noise.
        """
        options = self.options
        if options.lens_blur_pixels > 0:
            light = _blurred(light, options.lens_blur_pixels)
        if options.auto_exposure:
            gain = _MID_TONE * SATURATION / max(float((light * self._fixed).mean()), 1e-3)
        light = np.asarray(cv2.multiply(light, self._fixed, scale=gain), np.float32)
        if options.bayer:
            light = _demosaic(_with_noise(_mosaic(light), noise_gray, generator))
        code = np.empty_like(light)
        # A few rows at a time stay in the processor's cache.
        for top in range(0, len(light), _ROWS_AT_A_TIME):
            rows = slice(top, top + _ROWS_AT_A_TIME)
            noisy = light[rows]
            if not options.bayer:
                noisy = _with_noise(noisy, noise_gray, generator)
            code[rows] = encode(noisy)
        if options.sharpening > 0:
            code += np.float32(options.sharpening) * (code - _blurred(code, _SHARPENING_PIXELS))
            np.maximum(code, 0.0, out=code)
        # Rounds, and clips to 255.
        return np.asarray(cv2.convertScaleAbs(code), np.uint8)


def _blurred(image: Float32Array, sigma_pixels: float) -> Float32Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_pixels), np.float32)


def vignetting_image(image_size: tuple[int, int], share: float) -> Float32Array:
    """Return (H, W, 1): the light lost towards the corners, by the square of the radius."""
    width, height = image_size
    centre_x, centre_y = image_centre(image_size)
    x, y = np.meshgrid(np.arange(width) - centre_x, np.arange(height) - centre_y)
    radius_squared = (x * x + y * y) / (centre_x**2 + centre_y**2)
    return np.asarray(1.0 - share * radius_squared, np.float32)[..., None]


def _lamp_and_dust(image_size: tuple[int, int], options: ImagingOptions, seed: int) -> Float32Array:
    """Return (H, W, 1): what a lamp at the camera and dust on the glass make of every picture."""
    width, height = image_size
    generator = np.random.default_rng([seed, _FIXED])
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, width), np.linspace(-1.0, 1.0, height))
    phase = generator.uniform(0.0, math.tau, 2)
    lamp = np.sin(4.1 * x + phase[0]) * np.sin(3.3 * y + phase[1])
    pattern = np.asarray(1.0 + options.lamp_share * lamp, np.float32)
    for _ in range(options.dust):
        place = generator.uniform(0, width), generator.uniform(0, height)
        radius = generator.uniform(0.003, 0.012) * width
        spot = np.zeros((height, width), np.float32)
        cv2.circle(spot, (round(place[0]), round(place[1])), max(1, round(radius)), 1.0, -1)
        soft = _blurred(spot, 0.4 * radius + 0.5)
        pattern *= 1.0 - np.float32(generator.uniform(0.2, 0.6)) * soft
    return pattern[..., None]


def _with_noise(
    light: Float32Array, noise_gray: float, generator: np.random.Generator
) -> Float32Array:
    """Return light with photon noise, whose variance is the number of electrons, and read noise."""
    if noise_gray == 0.0:
        return light
    # Of such a full well the encoded mid-tone has this noise.
    slope = 1.055 / 2.4 * _MID_TONE ** (1 / 2.4 - 1)
    full_well = _MID_TONE * (SATURATION * slope / noise_gray) ** 2
    # On the scale of light, a variance of `photons` times it is that of its number of electrons.
    photons = np.float32(SATURATION / full_well)
    sigma = photons * np.maximum(light, 0.0)
    sigma += np.float32(_READ_NOISE_SHARE**2 * SATURATION) * photons
    np.sqrt(sigma, out=sigma)
    sigma *= _near_normal(light.shape, generator)
    sigma += light
    return sigma


def _near_normal(shape: tuple[int, ...], generator: np.random.Generator) -> Float32Array:
    """Return numbers of zero mean and unit variance, in steps of a quarter.

    How many of 64 random bits are set is all but normal (de Moivre), and quickly counted.
    """
    bits = generator.integers(0, 2**64 - 1, shape, np.uint64, endpoint=True)
    normal = np.asarray(np.bitwise_count(bits), np.float32)
    normal -= np.float32(32.0)
    normal *= np.float32(0.25)
    return normal


def _mosaic(light: Float32Array) -> Float32Array:
    """Return (H, W): one colour a pixel, as a Bayer filter (RGGB) lets through."""
    raw = light[..., 1].copy()
    raw[0::2, 0::2] = light[0::2, 0::2, 2]
    raw[1::2, 1::2] = light[1::2, 1::2, 0]
    return raw


def _demosaic(raw: Float32Array) -> Float32Array:
    """Return (H, W, 3) BGR light of a Bayer mosaic, by edge-aware interpolation."""
    scaled = np.clip(raw, 0.0, SATURATION) * np.float32(65535.0 / SATURATION)
    full = cv2.demosaicing(np.round(scaled).astype(np.uint16), cv2.COLOR_BayerRGGB2BGR_EA)
    return np.multiply(full, np.float32(SATURATION / 65535.0), dtype=np.float32)
