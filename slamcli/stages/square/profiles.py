"""Edge profiles: light across the sides of a quadrilateral, and where each shows its edge.

Where an edge lies is the least-squares place of a blurred step between two sides whose light may
change evenly with the distance, over the whole window: an integral of the profile whose weights
are alike to either side. Whatever symmetric blur, pixel area and interpolation did to the light
of a step leaves that place unmoved, and so do texture and shading that are smooth across the edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter1d
from scipy.special import ndtr

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.lens import Lens, distort_points
from slamcli.core.robust import SIGMA_PER_MAD
from slamcli.stages.square.candidates import inner_radius, line_through

PROFILE_STEP_PIXELS = 0.5
MIN_PROFILES = 12
# Beyond the transition, the light of either side is measured over this many pixels.
LEVEL_PIXELS = 3.0
# A step of fewer sigmas of a pixel's noise, or of less light of 255, is none.
_MIN_STEP_SIGMAS = 2.0
_MIN_LIGHT_STEP = 0.2
_MAX_PROFILES = 400
# Of a side, at either end: corners are rounded by blur.
_MARGIN_SHARE = 0.03
# Blurs tried, from a pixel's own area and the interpolation between pixels.
_SMALLEST_BLUR_PIXELS = 0.35
_BLURS = 24
_STEP_PROFILES = 5
_LEVEL_PROFILES = 5


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Light across one side: (N, T) values at `offsets` (T,), positive outwards."""

    origins: Float64Array
    normals: Float64Array
    offsets: Float64Array
    values: Float64Array
    usable: BoolArray

    @property
    def min_step(self) -> float:
        """Return the least step of light that is more than noise, by neighbouring profiles."""
        differences = np.abs(np.diff(self.values[self.usable], axis=0))
        noise = SIGMA_PER_MAD * float(np.median(differences)) / math.sqrt(2.0)
        return max(_MIN_STEP_SIGMAS * noise, _MIN_LIGHT_STEP)


@dataclass(frozen=True, slots=True, eq=False)
class EdgePlaces:
    """Where profiles have their edges: (N,) places and steps of light, and their common blur."""

    places: Float64Array
    steps: Float64Array
    blur_pixels: float


def read_profiles(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    half_length: float,
    bow_pixels: float = 0.0,
) -> Profiles | None:
    """Sample across one side, clear of the corners and of the neighbouring sides.

    `half_length` is in pixels; the side may be bent by a parabola of this sagitta (`Side`).
    """
    start, end = quad[index], quad[(index + 1) % 4]
    length = float(np.linalg.norm(end - start))
    count = int(np.clip(length, MIN_PROFILES, _MAX_PROFILES))
    steps = np.linspace(_MARGIN_SHARE, 1.0 - _MARGIN_SHARE, count)
    outward = np.array([end[1] - start[1], start[0] - end[0]]) / length
    bend = bow_pixels * (((2.0 * steps - 1.0) / (1.0 - 2.0 * _MARGIN_SHARE)) ** 2 - 1.0 / 3.0)
    points = start + (end - start) * steps[:, None] + outward * bend[:, None]
    origins = distort_points(lens, points)
    normals = distort_points(lens, points + outward) - origins
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    samples = 2 * math.ceil(half_length / PROFILE_STEP_PIXELS) + 1
    steps_across = np.arange(samples, dtype=np.float64) - samples // 2
    offsets: Float64Array = steps_across * PROFILE_STEP_PIXELS
    pixels = origins[:, None] + normals[:, None] * offsets[None, :, None]
    values = map_coordinates(image, [pixels[..., 1], pixels[..., 0]], order=1, mode="nearest")
    height, width = image.shape
    inside = np.all((pixels >= 0) & (pixels <= (width - 1, height - 1)), axis=(1, 2))
    # The innermost sample of a profile near a sharp corner would lie across the next side.
    innermost = points - outward * half_length
    clear = np.ones(count, dtype=bool)
    for other in ((index + 1) % 4, (index + 3) % 4):
        line = line_through(quad[other], quad[(other + 1) % 4])
        clear &= innermost @ line[:2] + line[2] < -1.5
    usable = inside & clear
    if usable.sum() < MIN_PROFILES // 2:
        return None
    return Profiles(origins, normals, offsets, np.asarray(values, dtype=np.float64), usable)


def measure_step(image: Float32Array, quad: Float64Array, lens: Lens, reach_pixels: float) -> float:
    """Return by how much the inside is lighter than the outside along most of the sides."""
    half = min(reach_pixels + LEVEL_PIXELS, 0.5 * inner_radius(quad))
    differences = []
    for index in range(4):
        profiles = read_profiles(image, quad, index, lens, half)
        if profiles is not None:
            values = profiles.values[profiles.usable]
            middle = len(profiles.offsets) // 2
            differences.append(
                values[:, :middle].mean(axis=1) - values[:, middle + 1 :].mean(axis=1)
            )
    return float(np.median(np.concatenate(differences))) if differences else 0.0


def blur_window(image: Float32Array, quad: Float64Array, lens: Lens, reach_pixels: float) -> float:
    """Return how far from the line, pixels, the transition reaches: blur, and the line's error."""
    largest = min(max(reach_pixels, 4.0) + 4.0, 0.4 * inner_radius(quad) - LEVEL_PIXELS)
    smallest = 2.0
    if largest <= smallest:
        return smallest
    widths = []
    for index in range(4):
        profiles = read_profiles(image, quad, index, lens, largest + LEVEL_PIXELS)
        if profiles is None:
            continue
        mean = np.median(profiles.values[profiles.usable], axis=0)
        levels = round(LEVEL_PIXELS / PROFILE_STEP_PIXELS)
        inside, outside = mean[:levels].mean(), mean[-levels:].mean()
        if abs(inside - outside) < _MIN_LIGHT_STEP:
            continue
        share = (mean - outside) / (inside - outside)
        widths.append(float(np.sum((share > 0.1) & (share < 0.9))) * PROFILE_STEP_PIXELS)
    return float(np.clip(1.0 + max(widths, default=1.0), smallest, largest))


def locate_edges_roughly(values: Float64Array, offsets: Float64Array) -> EdgePlaces:
    """Return what `locate_edges` does, less exactly, however far off the edges are.

    The integral of a profile, scaled to 1 inside and 0 outside, is the length that lies inside.
    """
    levels = round(LEVEL_PIXELS / PROFILE_STEP_PIXELS)
    # The mean of a few neighbours has the light of the two sides with less noise.
    inside = uniform_filter1d(values[:, :levels].mean(axis=1), _LEVEL_PROFILES, mode="nearest")
    outside = uniform_filter1d(values[:, -levels:].mean(axis=1), _LEVEL_PROFILES, mode="nearest")
    steps = inside - outside
    safe = np.where(np.abs(steps) < _MIN_LIGHT_STEP, np.inf, steps)
    share = (values[:, levels:-levels] - outside[:, None]) / safe[:, None]
    lengths = (share.sum(axis=1) - 0.5 * (share[:, 0] + share[:, -1])) * PROFILE_STEP_PIXELS
    return EdgePlaces(offsets[levels] + lengths, steps, math.inf)


def locate_edges(values: Float64Array, offsets: Float64Array) -> EdgePlaces:
    """Return where each profile has its edge, and how much lighter its inside is there.

    Parameters
    ----------
    values : (N, T)
        Light, from inside to outside.
    offsets : (T,)
        Positive outwards.
    """
    mean = _trimmed_mean(values)
    sigma = _edge_sigma(mean, offsets)
    fit = np.linalg.pinv(edge_model(offsets, sigma))
    parts = values @ fit.T
    # The mean of neighbours has the step between the two sides with less noise.
    step = uniform_filter1d(parts[:, 0] - parts[:, 1], _STEP_PROFILES, mode="nearest")
    return EdgePlaces(parts[:, 4] / step, step, sigma)


def _edge_sigma(mean: Float64Array, offsets: Float64Array) -> float:
    """Return the standard deviation, pixels, of the blur that explains a mean profile best."""
    sigmas = np.geomspace(_SMALLEST_BLUR_PIXELS, float(offsets[-1]) / 2.0, _BLURS)
    misfits = []
    for sigma in sigmas:
        model = edge_model(offsets, float(sigma))
        left = mean - model @ np.linalg.lstsq(model, mean, rcond=None)[0]
        misfits.append(float(left @ left))
    return float(sigmas[int(np.argmin(misfits))])


def edge_model(offsets: Float64Array, sigma: float) -> Float64Array:
    """Return (T, 5) columns: both sides' levels at the edge and their slopes, the edge's shift."""
    inside = ndtr(-offsets / sigma)
    outside = 1.0 - inside
    shift = np.exp(-0.5 * (offsets / sigma) ** 2) / (math.sqrt(math.tau) * sigma)
    return np.column_stack([inside, outside, offsets * inside, offsets * outside, shift])


def _trimmed_mean(values: Float64Array) -> Float64Array:
    """Return (T,) the mean of the middle three quarters of (N, T): touching paint stays out."""
    cut = len(values) // 8
    mean: Float64Array = np.sort(values, axis=0)[cut : len(values) - cut].mean(axis=0)
    return mean
