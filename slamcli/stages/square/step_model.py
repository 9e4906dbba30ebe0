"""The step of a side as a camera shows it: blurred, over the area of a pixel, encoded, sharpened.

Cameras sharpen the encoded picture with an unsharp mask, ``code + share * (code - blurred)``. As
the code is no linear function of light, that moves the place of an edge in light away from what
is lighter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from slamcli.core.arrays import Float64Array
from slamcli.core.light import Gamma, codes_of_light

FINE_STEP_PIXELS = 1.0 / 16.0
# Numbers that all sides have in common, and those of one side.
COMMON_COUNT, SIDE_COUNT = 3, 6


@dataclass(frozen=True, slots=True, eq=False)
class StepParameters:
    """Blur and mask, which all sides have in common, and each side's place and light.

    `sides` has a row a side: its place, inner and outer light, how these change per pixel
    outwards, and the logarithm of its blur over the common one: a colour filter and motion blur
    sides of other directions otherwise.
    """

    share: float
    radius_pixels: float
    blur_pixels: float
    sides: Float64Array

    @staticmethod
    def from_vector(values: Float64Array) -> StepParameters:
        """Return the parameters of a vector: share, log radius, blur, then side by side."""
        share, log_radius, blur = (float(value) for value in values[:COMMON_COUNT])
        sides = values[COMMON_COUNT:].reshape(-1, SIDE_COUNT)
        return StepParameters(share, math.exp(log_radius), blur, sides)

    @property
    def vector(self) -> Float64Array:
        """The vector that `from_vector` takes."""
        common = [self.share, math.log(self.radius_pixels), self.blur_pixels]
        return np.concatenate([common, self.sides.ravel()])


def fine_distances(half_length: float) -> Float64Array:
    """Return distances on which a step is computed, beyond all pixels of a profile."""
    steps = math.ceil((half_length + 2.0) / FINE_STEP_PIXELS)
    return np.asarray(np.arange(-steps, steps + 1) * FINE_STEP_PIXELS, np.float64)


def codes_of_step(
    parameters: StepParameters,
    row: int,
    widths: tuple[float, float],
    fine: Float64Array,
    gamma: Gamma,
    *,
    level: bool = False,
) -> Float64Array:
    """Return (F,) codes of pixels by their distance outside one side.

    Parameters
    ----------
    row : int
        Of the side, in `parameters.sides`.
    widths : (float, float)
        Of a pixel across the side.
    level : bool
        Without the change of light outwards, which is the floor's and not the camera's.
    """
    values = (float(value) for value in parameters.sides[row])
    place, inner, outer, inner_slope, outer_slope, log_blur = values
    blur = parameters.blur_pixels * math.exp(log_blur)
    inside = _step_over_pixels(place - fine, widths, blur)
    away = np.zeros_like(fine) if level else fine
    light = inside * (inner + inner_slope * away) + (1.0 - inside) * (outer + outer_slope * away)
    code = codes_of_light(light, gamma)
    radius = parameters.radius_pixels / FINE_STEP_PIXELS
    blurred = gaussian_filter1d(code, radius, mode="nearest", truncate=4.0)
    return np.clip(code + parameters.share * (code - blurred), 0.0, 255.0)


def _step_over_pixels(
    distance: Float64Array, widths: tuple[float, float], blur: float
) -> Float64Array:
    """Return the share of a blurred step that pixels have whose centres lie so far inside it.

    A pixel's square area, seen along the step, is a box of one width smoothed by one of the other.
    """
    wide, narrow = 0.5 * (widths[0] + widths[1]), 0.5 * (widths[0] - widths[1])
    outer = _twice_integrated(distance + wide, blur) + _twice_integrated(distance - wide, blur)
    inner = _twice_integrated(distance + narrow, blur) + _twice_integrated(distance - narrow, blur)
    share: Float64Array = (outer - inner) / (widths[0] * widths[1])
    return share


def _twice_integrated(distance: Float64Array, blur: float) -> Float64Array:
    """Return the second integral of a blurred step."""
    scaled = distance / blur
    density = np.exp(-0.5 * scaled**2) * (blur / math.sqrt(math.tau))
    integral: Float64Array = 0.5 * ((distance**2 + blur**2) * ndtr(scaled) + distance * density)
    return integral
