"""The sides of a square to a few hundredths of a pixel: profiles across them, and lines fitted.

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
from scipy.ndimage import map_coordinates, uniform_filter1d

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array
from slamcli.core.camera.lens import Lens, distort_points, undistort_points
from slamcli.stages.square.candidates import intersect, is_convex, line_through, quad_area
from slamcli.stages.square.lines import Side, fit_side, fit_side_robustly, ransac_weights

_PROFILE_STEP_PIXELS = 0.5
_MAX_PROFILES = 400
_MIN_PROFILES = 12
_COARSE_BOX_PIXELS = 2.0
_FINE_ROUNDS = 3
# Beyond the transition, so many pixels on either side tell the two levels.
_LEVEL_PIXELS = 3.0
_MIN_INLIER_SHARE = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class EdgedQuad:
    """A quadrilateral whose sides were fitted to the picture.

    Attributes
    ----------
    corners : (4, 2) float64
        Undistorted pixels, clockwise in the picture.
    covariance : (8, 8) float64
        Of the corners (x0, y0, x1, ...), pixels squared; neighbours share a side, so it is full.
    support : float
        Share of the profiles, on the whole and on the worst side alike, that show the side.
    contrast : float
        Gray levels from outside to inside; negative when the inside is darker.
    bow_pixels : float
        Largest sagitta of a side: a lens that was not told of bends them.
    residual_pixels : float
        Root mean square of the edge points about their lines.
    """

    corners: Float64Array
    covariance: Float64Array
    support: float
    contrast: float
    bow_pixels: float
    residual_pixels: float


@dataclass(frozen=True, slots=True, eq=False)
class _Profiles:
    """Gray values across one side: (N, T) values at `offsets` (T,), positive outwards."""

    origins: Float64Array
    normals: Float64Array
    offsets: Float64Array
    values: Float64Array
    usable: BoolArray


def refine_quad(
    image: Float32Array, corners: Float64Array, lens: Lens, reach_pixels: float
) -> EdgedQuad | None:
    """Fit the four sides of a quadrilateral to the picture's edges and intersect them.

    Parameters
    ----------
    image : (H, W) float32
    corners : (4, 2)
        Undistorted pixels, clockwise in the picture.
    lens : Lens
        Lines are straight in undistorted pixels only; profiles are read in the picture itself.
    reach_pixels : float
        How far the sides may be from where the corners put them.

    Returns
    -------
    EdgedQuad or None
        None when a side shows no edge.
    """
    quad = corners
    polarity = _polarity(image, quad, lens, reach_pixels)
    window = reach_pixels
    for round_number in range(1 + _FINE_ROUNDS):
        sides = []
        for index in range(4):
            if round_number == 0:
                side = _coarse_side(image, quad, index, lens, window, polarity)
            else:
                side = _fine_side(image, quad, index, lens, window, polarity)
            if side is None or side.support < _MIN_INLIER_SHARE:
                return None
            sides.append(side)
        lines = np.array([side.line for side in sides])
        quad = intersect(np.roll(lines, 1, axis=0), lines)
        if not np.all(np.isfinite(quad)) or not is_convex(quad):
            return None
        if round_number == 0:
            window = _blur_window(image, quad, lens, reach_pixels)
    # Sides that are bent although the lens is known are not straight on the floor.
    bent = not np.any(lens.distortion)
    return _assemble(_follow_bow(quad, sides) if bent else quad, sides)


def _follow_bow(quad: Float64Array, sides: list[Side]) -> Float64Array:
    """Move the corners from where the sides' lines meet to where their parabolas do."""
    moved = quad.copy()
    for corner in range(4):
        pair = [sides[corner - 1], sides[corner]]
        normals = np.array([side.line[:2] for side in pair])
        places = [
            float((quad[corner] - side.centre) @ side.direction) / side.half_length for side in pair
        ]
        # A parabola and the line fitted to it part by sagitta (x^2 - 1/3) on [-1, 1].
        parting = [
            side.bow_pixels * (place**2 - 1.0 / 3.0)
            for side, place in zip(pair, places, strict=True)
        ]
        moved[corner] += np.linalg.solve(normals, parting)
    return moved


def inner_radius(quad: Float64Array) -> float:
    """Return about the radius, pixels, of the largest circle in a quadrilateral."""
    perimeter = float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).sum())
    return 2.0 * float(quad_area(quad)) / perimeter


def _read_profiles(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    half_length: float,
) -> _Profiles | None:
    """Sample across one side, clear of the corners and of the neighbouring sides."""
    start, end = quad[index], quad[(index + 1) % 4]
    length = float(np.linalg.norm(end - start))
    count = int(np.clip(length, _MIN_PROFILES, _MAX_PROFILES))
    steps = np.linspace(0.03, 0.97, count)
    points = start + (end - start) * steps[:, None]
    outward = np.array([end[1] - start[1], start[0] - end[0]]) / length
    origins = distort_points(lens, points)
    normals = distort_points(lens, points + outward) - origins
    normals = np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), np.float64)
    samples = 2 * math.ceil(half_length / _PROFILE_STEP_PIXELS) + 1
    steps_across = np.arange(samples, dtype=np.float64) - samples // 2
    offsets: Float64Array = steps_across * _PROFILE_STEP_PIXELS
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
    if usable.sum() < _MIN_PROFILES // 2:
        return None
    return _Profiles(origins, normals, offsets, np.asarray(values, dtype=np.float64), usable)


def _polarity(image: Float32Array, quad: Float64Array, lens: Lens, reach_pixels: float) -> float:
    """Return +1 where the inside is lighter than the outside along most of the sides, else -1."""
    half = min(reach_pixels + _LEVEL_PIXELS, 0.5 * inner_radius(quad))
    differences = []
    for index in range(4):
        profiles = _read_profiles(image, quad, index, lens, half)
        if profiles is not None:
            values = profiles.values[profiles.usable]
            middle = len(profiles.offsets) // 2
            differences.append(
                values[:, :middle].mean(axis=1) - values[:, middle + 1 :].mean(axis=1)
            )
    if not differences:
        return 1.0
    return 1.0 if float(np.median(np.concatenate(differences))) >= 0 else -1.0


def _coarse_side(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    reach_pixels: float,
    polarity: float,
) -> Side | None:
    """Take each profile's strongest step of the right sign; RANSAC tells the line among them."""
    half = min(reach_pixels, 0.45 * inner_radius(quad)) + _COARSE_BOX_PIXELS
    profiles = _read_profiles(image, quad, index, lens, half)
    if profiles is None:
        return None
    width = round(_COARSE_BOX_PIXELS / _PROFILE_STEP_PIXELS)
    sums = np.cumsum(np.pad(profiles.values * polarity, ((0, 0), (1, 0))), axis=1)
    boxes = (sums[:, width:] - sums[:, :-width]) / width
    step = boxes[:, : -width - 1] - boxes[:, width + 1 :]
    best = step.argmax(axis=1)
    height = step[np.arange(len(step)), best]
    offsets = profiles.offsets[best + width]
    typical = float(np.median(height[profiles.usable]))
    good = profiles.usable & (height > 0.4 * typical) & (height > 2.0)
    if good.sum() < _MIN_PROFILES // 2:
        return None
    edge = profiles.origins + profiles.normals * offsets[:, None]
    points = undistort_points(lens, edge)[good]
    weights = ransac_weights(points)
    return fit_side(
        points, weights, len(profiles.usable), polarity * typical, float(image.shape[1])
    )


def _fine_side(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    window: float,
    polarity: float,
) -> Side | None:
    """Read the edge of each profile off its integral and fit the line with Tukey's weights."""
    profiles = _read_profiles(image, quad, index, lens, window + _LEVEL_PIXELS)
    if profiles is None:
        return None
    levels = round(_LEVEL_PIXELS / _PROFILE_STEP_PIXELS)
    # A few neighbours together tell the levels of the two sides with less noise.
    inside = uniform_filter1d(profiles.values[:, :levels].mean(axis=1), 5, mode="nearest")
    outside = uniform_filter1d(profiles.values[:, -levels:].mean(axis=1), 5, mode="nearest")
    contrast = (inside - outside) * polarity
    typical = float(np.median(contrast[profiles.usable]))
    if typical < 2.0:
        return None
    good = profiles.usable & (contrast > 0.6 * typical) & (contrast < 1.6 * typical)
    if good.sum() < _MIN_PROFILES // 2:
        return None
    core = profiles.values[:, levels:-levels]
    share = (core - outside[:, None])[good] / (inside - outside)[good, None]
    position = _locate(share, profiles.offsets[levels:-levels])
    near = np.abs(position) < window
    if near.sum() < _MIN_PROFILES // 2:
        return None
    edge = (profiles.origins[good] + profiles.normals[good] * position[:, None])[near]
    points = undistort_points(lens, edge)
    return fit_side_robustly(
        points, int(profiles.usable.sum()), polarity * typical, float(image.shape[1])
    )


def _locate(share: Float64Array, offsets: Float64Array) -> Float64Array:
    """Return (N,) where each profile (N, T), scaled to 1 inside and 0 outside, has its edge.

    The mean profile is placed by its integral; each single one against the mean by matching it
    with the mean's derivative, the least-squares shift, which noise away from the edge leaves be.
    """
    mean = _trimmed_mean(share)
    # The trapezoidal rule, with the whole length inside counted from the window's inner end.
    length_inside = (mean.sum() - 0.5 * (mean[0] + mean[-1])) * _PROFILE_STEP_PIXELS
    slope = np.gradient(mean, _PROFILE_STEP_PIXELS)
    shift = -(share - mean) @ slope / float(slope @ slope)
    position: Float64Array = offsets[0] + length_inside + shift
    return position


def _trimmed_mean(values: Float64Array) -> Float64Array:
    """Return (T,) the mean of the middle three quarters of (N, T): touching paint stays out."""
    cut = len(values) // 8
    mean: Float64Array = np.sort(values, axis=0)[cut : len(values) - cut].mean(axis=0)
    return mean


def _blur_window(image: Float32Array, quad: Float64Array, lens: Lens, reach_pixels: float) -> float:
    """Return how far from the line, pixels, the transition reaches: blur, and the line's error."""
    largest = min(max(reach_pixels, 4.0) + 4.0, 0.4 * inner_radius(quad) - _LEVEL_PIXELS)
    smallest = 2.0
    if largest <= smallest:
        return smallest
    widths = []
    for index in range(4):
        profiles = _read_profiles(image, quad, index, lens, largest + _LEVEL_PIXELS)
        if profiles is None:
            continue
        mean = np.median(profiles.values[profiles.usable], axis=0)
        levels = round(_LEVEL_PIXELS / _PROFILE_STEP_PIXELS)
        inside, outside = mean[:levels].mean(), mean[-levels:].mean()
        if abs(inside - outside) < 1.0:
            continue
        share = (mean - outside) / (inside - outside)
        widths.append(float(np.sum((share > 0.1) & (share < 0.9))) * _PROFILE_STEP_PIXELS)
    return float(np.clip(1.0 + max(widths, default=1.0), smallest, largest))


def _assemble(quad: Float64Array, sides: list[Side]) -> EdgedQuad:
    supports = np.array([side.support for side in sides])
    # Corner k is where sides k - 1 and k meet: n . corner = place, to first order, for each.
    jacobian = np.zeros((8, 8))
    for corner in range(4):
        pair = [(corner - 1) % 4, corner]
        normals = np.array([sides[i].line[:2] for i in pair])
        inverse = np.linalg.inv(normals)
        for column, side_index in enumerate(pair):
            side = sides[side_index]
            lever = float((quad[corner] - side.centre) @ side.direction)
            block = np.outer(inverse[:, column], [1.0, lever])
            jacobian[2 * corner : 2 * corner + 2, 2 * side_index : 2 * side_index + 2] = block
    lines = np.zeros((8, 8))
    for index, side in enumerate(sides):
        lines[2 * index : 2 * index + 2, 2 * index : 2 * index + 2] = side.covariance
    bow = max((side.bow_pixels for side in sides), key=abs)
    # What bends the sides, an unknown lens or an uneven floor, moves the corners about as much.
    bent = np.eye(8) * (0.5 * bow) ** 2
    return EdgedQuad(
        corners=quad,
        covariance=jacobian @ lines @ jacobian.T + bent,
        support=float(0.5 * (supports.min() + supports.mean())),
        contrast=float(np.mean([side.contrast for side in sides])),
        bow_pixels=bow,
        residual_pixels=float(np.sqrt(np.mean([side.residual_pixels**2 for side in sides]))),
    )
