"""Side fits: the sides of a square, and its corners, to a few hundredths of a pixel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.lens import Lens, undistort_points
from slamcli.stages.square.candidates import inner_radius, intersect, is_convex
from slamcli.stages.square.lines import Side, fit_side, fit_side_robustly, ransac_weights
from slamcli.stages.square.profiles import (
    LEVEL_PIXELS,
    MIN_PROFILES,
    PROFILE_STEP_PIXELS,
    blur_window,
    locate_edges,
    locate_edges_roughly,
    measure_step,
    read_profiles,
)

_COARSE_BOX_PIXELS = 2.0
_ROUGH_ROUNDS = 2
_FINE_ROUNDS = 3
# How far from the line the transition reaches, once its blur is known: what lies farther out may
# be another edge [benchmarks/calibration_targets.py].
_WINDOW_BLURS = 3.0
_WINDOW_MARGIN_PIXELS = 1.0
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
    bow_pixels : float
        Largest sagitta of a side: an unknown lens bends them.
    residual_pixels : float
        Root mean square of the edge points about their lines.
    """

    corners: Float64Array
    covariance: Float64Array
    support: float
    bow_pixels: float
    residual_pixels: float
    sides: tuple[Side, ...]


@dataclass(frozen=True, slots=True)
class _Reading:
    """How a side is read: how far from it, its sign of step, its sagitta so far, how exactly."""

    window_pixels: float
    polarity: float
    bow_pixels: float
    rough: bool


def refine_quad(
    image: Float32Array, corners: Float64Array, lens: Lens, reach_pixels: float
) -> EdgedQuad | None:
    """Fit the four sides of a quadrilateral to the picture's edges and intersect them.

    Parameters
    ----------
    image : (H, W) float32
        Light.
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
    polarity = math.copysign(1.0, measure_step(image, quad, lens, reach_pixels))
    window = reach_pixels
    sides: list[Side] = []
    for round_number in range(1 + _ROUGH_ROUNDS + _FINE_ROUNDS):
        bows = [side.bow_pixels for side in sides]
        sides = []
        for index in range(4):
            if round_number == 0:
                side = _coarse_side(image, quad, index, lens, window, polarity)
            else:
                rough = round_number <= _ROUGH_ROUNDS
                reading = _Reading(window, polarity, bows[index], rough)
                side = _fine_side(image, quad, index, lens, reading)
            if side is None or side.support < _MIN_INLIER_SHARE:
                return None
            sides.append(side)
        quad = corners_of_sides(sides)
        if not np.all(np.isfinite(quad)) or not is_convex(quad):
            return None
        if round_number == 0:
            window = blur_window(image, quad, lens, reach_pixels)
        else:
            blur = max(side.blur_pixels for side in sides)
            window = min(window, _WINDOW_BLURS * blur + _WINDOW_MARGIN_PIXELS)
    return assemble(sides, lens)


def corners_of_sides(sides: Sequence[Side]) -> Float64Array:
    """Return (4, 2): where the lines of neighbouring sides meet."""
    lines = np.array([side.line for side in sides])
    return intersect(np.roll(lines, 1, axis=0), lines)


def _follow_bow(quad: Float64Array, sides: Sequence[Side]) -> Float64Array:
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


def _coarse_side(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    reach_pixels: float,
    polarity: float,
) -> Side | None:
    """Take each profile's strongest step of the right sign; RANSAC finds the line among them."""
    half = min(reach_pixels, 0.45 * inner_radius(quad)) + _COARSE_BOX_PIXELS
    profiles = read_profiles(image, quad, index, lens, half)
    if profiles is None:
        return None
    width = round(_COARSE_BOX_PIXELS / PROFILE_STEP_PIXELS)
    sums = np.cumsum(np.pad(profiles.values * polarity, ((0, 0), (1, 0))), axis=1)
    boxes = (sums[:, width:] - sums[:, :-width]) / width
    step = boxes[:, : -width - 1] - boxes[:, width + 1 :]
    best = step.argmax(axis=1)
    height = step[np.arange(len(step)), best]
    offsets = profiles.offsets[best + width]
    typical = float(np.median(height[profiles.usable]))
    good = profiles.usable & (height > 0.4 * typical) & (height > profiles.min_step)
    if good.sum() < MIN_PROFILES // 2:
        return None
    edge = profiles.origins + profiles.normals * offsets[:, None]
    points = undistort_points(lens, edge)[good]
    weights = ransac_weights(points)
    return fit_side(points, weights, len(profiles.usable), float(image.shape[1]))


def _fine_side(
    image: Float32Array,
    quad: Float64Array,
    index: int,
    lens: Lens,
    reading: _Reading,
) -> Side | None:
    """Place the edge in each profile by `locate_edges`, and a line with Tukey's weights."""
    profiles = read_profiles(
        image, quad, index, lens, reading.window_pixels + LEVEL_PIXELS, reading.bow_pixels
    )
    if profiles is None:
        return None
    usable = np.flatnonzero(profiles.usable)
    locate = locate_edges_roughly if reading.rough else locate_edges
    found = locate(profiles.values[usable], profiles.offsets)
    contrast = found.steps * reading.polarity
    typical = float(np.median(contrast))
    if typical < profiles.min_step:
        return None
    good = (
        (contrast > 0.6 * typical)
        & (contrast < 1.6 * typical)
        & (np.abs(found.places) < reading.window_pixels)
    )
    if good.sum() < MIN_PROFILES // 2:
        return None
    places = found.places[good, None]
    kept = usable[good]
    edge = profiles.origins[kept] + profiles.normals[kept] * places
    points = undistort_points(lens, edge)
    side = fit_side_robustly(points, len(usable), float(image.shape[1]))
    return replace(side, blur_pixels=found.blur_pixels)


def assemble(
    sides: Sequence[Side], lens: Lens, shift_covariance: Float64Array | None = None
) -> EdgedQuad:
    """Return the quadrilateral with the covariance that its sides' lines give its corners."""
    quad = corners_of_sides(sides)
    # Sides that are bent although the lens is known are not straight on the floor.
    if not np.any(lens.distortion):
        quad = _follow_bow(quad, sides)
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
    if shift_covariance is not None:
        lines[::2, ::2] += shift_covariance
    bow = max((side.bow_pixels for side in sides), key=abs)
    # What bends the sides, an unknown lens or an uneven floor, moves the corners about as much.
    bent = np.eye(8) * (0.5 * bow) ** 2
    return EdgedQuad(
        corners=quad,
        covariance=jacobian @ lines @ jacobian.T + bent,
        support=float(0.5 * (supports.min() + supports.mean())),
        bow_pixels=bow,
        residual_pixels=float(np.sqrt(np.mean([side.residual_pixels**2 for side in sides]))),
        sides=tuple(sides),
    )
