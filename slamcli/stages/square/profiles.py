"""Edge profiles: gray values across the sides of a quadrilateral, and where each shows its edge.

Where an edge lies in one profile is read off its integral, not off its steepest place: for a step
from ``outside`` to ``inside`` the sum of ``(value - outside) / (inside - outside)`` over the window
is the length that lies inside, whatever symmetric blur, pixel area and interpolation did to the
step (the moment-preserving principle of Tabatabai and Mitchell, PAMI 1984). An edge that runs
along the pixel grid, where every profile has the same phase, therefore has no bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.lens import Lens, distort_points
from slamcli.stages.square.candidates import inner_radius, line_through

PROFILE_STEP_PIXELS = 0.5
MIN_PROFILES = 12
# Beyond the transition, the gray levels of either side are measured over this many pixels.
LEVEL_PIXELS = 3.0
_MAX_PROFILES = 400


@dataclass(frozen=True, slots=True, eq=False)
class Profiles:
    """Gray values across one side: (N, T) values at `offsets` (T,), positive outwards."""

    origins: Float64Array
    normals: Float64Array
    offsets: Float64Array
    values: Float64Array
    usable: BoolArray


def read_profiles(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    half_length: float,
) -> Profiles | None:
    """Sample across one side, clear of the corners and of the neighbouring sides."""
    start, end = quad[index], quad[(index + 1) % 4]
    length = float(np.linalg.norm(end - start))
    count = int(np.clip(length, MIN_PROFILES, _MAX_PROFILES))
    steps = np.linspace(0.03, 0.97, count)
    points = start + (end - start) * steps[:, None]
    outward = np.array([end[1] - start[1], start[0] - end[0]]) / length
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


def measure_polarity(
    image: Float32Array, quad: Float64Array, lens: Lens, reach_pixels: float
) -> float:
    """Return +1 where the inside is lighter than the outside along most of the sides, else -1."""
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
    if not differences:
        return 1.0
    return 1.0 if float(np.median(np.concatenate(differences))) >= 0 else -1.0


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
        if abs(inside - outside) < 1.0:
            continue
        share = (mean - outside) / (inside - outside)
        widths.append(float(np.sum((share > 0.1) & (share < 0.9))) * PROFILE_STEP_PIXELS)
    return float(np.clip(1.0 + max(widths, default=1.0), smallest, largest))


def locate_edges(share: Float64Array, offsets: Float64Array) -> Float64Array:
    """Return (N,) where each profile (N, T), scaled to 1 inside and 0 outside, has its edge.

    The mean profile is placed by its integral; each single one against the mean by matching it
    with the mean's derivative, the least-squares shift, which noise away from the edge leaves be.
    """
    mean = _trimmed_mean(share)
    # The trapezoidal rule, with the whole length inside counted from the window's inner end.
    length_inside = (mean.sum() - 0.5 * (mean[0] + mean[-1])) * PROFILE_STEP_PIXELS
    slope = np.gradient(mean, PROFILE_STEP_PIXELS)
    shift = -(share - mean) @ slope / float(slope @ slope)
    position: Float64Array = offsets[0] + length_inside + shift
    return position


def _trimmed_mean(values: Float64Array) -> Float64Array:
    """Return (T,) the mean of the middle three quarters of (N, T): touching paint stays out."""
    cut = len(values) // 8
    mean: Float64Array = np.sort(values, axis=0)[cut : len(values) - cut].mean(axis=0)
    return mean
