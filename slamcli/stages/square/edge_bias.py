"""Bias of edges by what the camera does to the picture: its pixels' areas, and sharpening.

Cameras sharpen the encoded picture with an unsharp mask, ``code + share * (code - blurred)``. As
the code is no linear function of light, that moves the place of an edge in light away from what
is lighter. And where a side runs along the pixel grid, all profiles see the step at the same phase.
A blurred step of light, encoded, sharpened and sampled as the picture's own pixels are, is fitted
to the mean profiles of all sides; by how much edges of this model are misplaced is taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.special import ndtr

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.lens import Lens
from slamcli.core.light import Gamma, codes_of_light, light_of_codes, light_of_fractions
from slamcli.stages.square.candidates import inner_radius, intersect, line_through
from slamcli.stages.square.edges import EdgedQuad
from slamcli.stages.square.profiles import Profiles, locate_edges, read_profiles

_REACH_PIXELS = 8.0
_FINE_STEP_PIXELS = 1.0 / 16.0
_MIN_SAMPLES = 9
# Profiles whose step is not like that of most show something else.
_STEP_RANGE = (0.6, 1.6)
_MAX_PLACE_PIXELS = 1.5
_MAX_BOW_PIXELS = 0.5
# Sides that lie farther from their lines are bent: the model's step is put no farther out.
_MAX_MEAN_PLACE_PIXELS = 0.2
# A usual camera's mask before anything is measured: its radius within a third more or less, and
# how much it may sharpen [benchmarks/calibration_targets.py].
_USUAL_RADIUS_PIXELS, _RADIUS_LOG_SIGMA = 1.0, 0.3
_SHARE_SIGMA = 1.0
# Of how the light changes per pixel outwards, as a share of the step.
_SLOPE_SIGMA_SHARE = 0.02
_MAX_SHARE = 4.0
_RADIUS_RANGE_PIXELS = (0.6, 4.0)
_BLUR_RANGE_PIXELS = (0.05, 5.0)
_START_SHARE, _START_BLUR_PIXELS = 0.3, 0.7
# Of a mean profile, in codes: what neither blur nor mask explains, at least.
_MIN_CODE_SIGMA = 0.3
_FITS = 2
# A side along the pixels' rows or columns sees no shorter edge of them.
_MIN_WIDTH_PIXELS = 0.02
# Error of the correction, as a share of it, of cameras that sharpen in another way.
_MODEL_ERROR_SHARE = 0.2
# A side whose mean profile the model leaves more of is not corrected by it: other edges, shadows.
_MAX_UNEXPLAINED_SHARE = 0.08


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One side's profiles, and where the pixels lie that they were interpolated from.

    Attributes
    ----------
    index : int
        Of the side.
    offsets : (T,) float64
    codes : (T,) float64
        Mean profile.
    distances, weights : (N, T, 4) float64
        Of the four pixels around each sample: how far outside the side, and their shares.
    mean_from_fine : (T, F) float64
        The mean profile of a function of the distance on the fine grid.
    places : (N,) float64
        Of the profiles along the side, from 0 to 1.
    widths : (float, float)
        Of a pixel across the side: the longer and the shorter of its edges as seen that way.
    """

    index: int
    offsets: Float64Array
    codes: Float64Array
    distances: Float64Array
    weights: Float64Array
    mean_from_fine: Float64Array
    places: Float64Array
    widths: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Parameters:
    """What is fitted: blur and mask, which all sides have in common, and each side's light.

    `lights` has a row a side: its place, inner and outer light, and how these change outwards.
    """

    share: float
    radius_pixels: float
    blur_pixels: float
    lights: Float64Array

    @staticmethod
    def from_vector(values: Float64Array) -> _Parameters:
        """Return the parameters of a vector: share, log radius, blur, then side by side."""
        share, log_radius, blur = (float(value) for value in values[:3])
        return _Parameters(share, math.exp(log_radius), blur, values[3:].reshape(-1, 5))


def correct_bias(codes: Float32Array, edged: EdgedQuad, lens: Lens, gamma: Gamma) -> EdgedQuad:
    """Return the quadrilateral with its sides where a perfect camera would show them.

    Parameters
    ----------
    codes : (H, W) float32
        The encoded picture, 0 to 255.
    edged : EdgedQuad
        Fitted to the same picture's light.
    lens : Lens
    gamma : Gamma
    """
    if abs(edged.bow_pixels) > _MAX_BOW_PIXELS:
        return edged
    half = min(_REACH_PIXELS, 0.5 * inner_radius(edged.corners))
    fine = _fine_grid(half)
    found = [_read_side(codes, edged.corners, index, lens, half) for index in range(4)]
    sides = [side for side in found if side is not None]
    if not sides:
        return edged
    fitted, share_sigma = _fit(sides, fine, gamma)
    ends = np.full((4, 2), np.nan)
    for row, side in zip(fitted.lights, sides, strict=True):
        if not _explained(fitted, row, side, fine, gamma):
            continue
        row[0] = np.clip(row[0], -_MAX_MEAN_PLACE_PIXELS, _MAX_MEAN_PLACE_PIXELS)
        light = light_of_fractions(_codes(fitted, row, side.widths, fine, gamma, level=True), gamma)
        values = np.sum(np.interp(side.distances, fine, light) * side.weights, axis=2)
        misplaced = locate_edges(values, side.offsets).places - row[0]
        slope, start = np.polyfit(side.places, misplaced, 1)
        ends[side.index] = start, start + slope
    if np.all(np.isnan(ends)):
        return edged
    # Sides that show something else as well are taken to be like the others.
    ends = np.where(np.isnan(ends), np.nanmean(ends), ends)
    corners = _moved_inwards(edged.corners, ends)
    change = (corners - edged.corners).ravel()
    uncertain = math.hypot(_MODEL_ERROR_SHARE, share_sigma / max(fitted.share, share_sigma))
    covariance = edged.covariance + np.outer(change, change) * uncertain**2
    return replace(edged, corners=corners, covariance=covariance)


def _explained(
    fitted: _Parameters, row: Float64Array, side: _Side, fine: Float64Array, gamma: Gamma
) -> bool:
    """Return whether the model explains nearly all of a side's mean profile."""
    left = side.codes - side.mean_from_fine @ _codes(fitted, row, side.widths, fine, gamma)
    return float(np.abs(left).max()) < _MAX_UNEXPLAINED_SHARE * float(np.ptp(side.codes))


def _moved_inwards(corners: Float64Array, ends: Float64Array) -> Float64Array:
    """Move the sides inwards, by (4, 2) pixels at each one's start and end; return the corners."""
    following = np.roll(corners, -1, axis=0)
    outward = line_through(corners, following)[:, :2]
    lines = line_through(corners - outward * ends[:, :1], following - outward * ends[:, 1:])
    return intersect(np.roll(lines, 1, axis=0), lines)


def _fine_grid(half_length: float) -> Float64Array:
    """Return distances on which the modelled step is computed, beyond all pixels of a profile."""
    steps = math.ceil((half_length + 2.0) / _FINE_STEP_PIXELS)
    return np.asarray(np.arange(-steps, steps + 1) * _FINE_STEP_PIXELS, np.float64)


def _read_side(
    codes: Float32Array, quad: Float64Array, index: int, lens: Lens, half_length: float
) -> _Side | None:
    profiles = read_profiles(codes, quad, index, lens, half_length)
    if profiles is None or len(profiles.offsets) < _MIN_SAMPLES:
        return None
    edges = locate_edges(profiles.values, profiles.offsets)
    relative = edges.steps / np.median(edges.steps[profiles.usable])
    low, high = _STEP_RANGE
    kept = np.flatnonzero(
        profiles.usable
        & (relative > low)
        & (relative < high)
        & (np.abs(edges.places) < _MAX_PLACE_PIXELS)
    )
    if len(kept) < _MIN_SAMPLES:
        return None
    distances, weights = _neighbours(profiles)
    distances, weights = distances[kept], weights[kept]
    fine = _fine_grid(half_length)
    across = np.sort(np.abs(profiles.normals.mean(axis=0)))
    return _Side(
        index=index,
        offsets=profiles.offsets,
        codes=profiles.values[kept].mean(axis=0),
        distances=distances,
        weights=weights,
        mean_from_fine=_mean_operator(distances, weights, fine),
        places=kept / (len(profiles.usable) - 1.0),
        widths=(float(across[1]), max(float(across[0]), _MIN_WIDTH_PIXELS)),
    )


def _neighbours(profiles: Profiles) -> tuple[Float64Array, Float64Array]:
    """Return (N, T, 4): the pixels around each sample, as distances outwards, and weights."""
    steps = profiles.normals[:, None] * profiles.offsets[None, :, None]
    samples = profiles.origins[:, None] + steps
    low = np.floor(samples)
    share = samples - low
    distances, weights = [], []
    for column in (0.0, 1.0):
        for row in (0.0, 1.0):
            away = low + np.array([column, row]) - profiles.origins[:, None]
            distances.append(np.sum(away * profiles.normals[:, None], axis=2))
            across = share[..., 0] if column else 1.0 - share[..., 0]
            weights.append(across * (share[..., 1] if row else 1.0 - share[..., 1]))
    return np.stack(distances, axis=-1), np.stack(weights, axis=-1)


def _mean_operator(
    distances: Float64Array, weights: Float64Array, fine: Float64Array
) -> Float64Array:
    """Return (T, F): the mean profile of a function given on the fine grid."""
    place = np.clip((distances - fine[0]) / _FINE_STEP_PIXELS, 0.0, len(fine) - 1.001)
    low = place.astype(np.intp)
    share = place - low
    count = distances.shape[1]
    sample = np.broadcast_to(np.arange(count)[None, :, None], low.shape)
    operator = np.zeros((count, len(fine)))
    np.add.at(operator, (sample, low), weights * (1.0 - share))
    np.add.at(operator, (sample, low + 1), weights * share)
    return operator / len(distances)


def _fit(sides: list[_Side], fine: Float64Array, gamma: Gamma) -> tuple[_Parameters, float]:
    """Return the parameters that explain the sides' mean profiles best, and the share's sigma."""
    observed = np.concatenate([side.codes for side in sides])
    table = light_of_codes(gamma)
    lights = np.zeros((len(sides), 5))
    for row, side in zip(lights, sides, strict=True):
        row[1:3] = np.interp(side.codes[[0, -1]], np.arange(256), table)
    contrasts = np.abs(lights[:, 1:2] - lights[:, 2:3]) + 1.0
    mask = [_START_SHARE, math.log(_USUAL_RADIUS_PIXELS), _START_BLUR_PIXELS]
    start = np.concatenate([mask, lights.ravel()])
    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    radii = np.log(_RADIUS_RANGE_PIXELS)
    low[:3], high[:3] = np.array([(0.0, _MAX_SHARE), radii, _BLUR_RANGE_PIXELS]).T
    # No side is darker than black.
    low[4::5] = low[5::5] = -1e-6
    sigma = 1.0

    # Slow to load, and needed only here.
    from scipy.optimize import least_squares

    def misfit(values: Float64Array) -> Float64Array:
        parameters = _Parameters.from_vector(values)
        modelled = [
            side.mean_from_fine @ _codes(parameters, row, side.widths, fine, gamma)
            for row, side in zip(parameters.lights, sides, strict=True)
        ]
        left = (np.concatenate(modelled) - observed) / sigma
        usual = (values[1] - math.log(_USUAL_RADIUS_PIXELS)) / _RADIUS_LOG_SIGMA
        slopes = parameters.lights[:, 3:] / (_SLOPE_SIGMA_SHARE * contrasts)
        return np.concatenate([left, [values[0] / _SHARE_SIGMA, usual], slopes.ravel()])

    for _ in range(_FITS):
        fit = least_squares(misfit, start, bounds=(low, high), x_scale="jac", max_nfev=40)
        start = np.asarray(fit.x, np.float64)
        freedom = max(len(observed) - len(start), 1)
        sigma = max(
            sigma * math.sqrt(float(np.sum(fit.fun[: len(observed)] ** 2)) / freedom),
            _MIN_CODE_SIGMA,
        )
    jacobian = np.asarray(fit.jac, np.float64)
    variance = float(np.linalg.pinv(jacobian.T @ jacobian)[0, 0])
    return _Parameters.from_vector(start), math.sqrt(variance)


def _codes(
    parameters: _Parameters,
    row: Float64Array,
    widths: tuple[float, float],
    fine: Float64Array,
    gamma: Gamma,
    *,
    level: bool = False,
) -> Float64Array:
    """Return (F,) codes of pixels by their distance outside one side.

    Parameters
    ----------
    row : (5,)
        Of the side, in `parameters.lights`.
    widths : (float, float)
        Of a pixel across the side.
    level : bool
        Without the change of light outwards, which is the floor's and not the camera's.
    """
    place, inner, outer, inner_slope, outer_slope = (float(value) for value in row)
    inside = _step_over_pixels(place - fine, widths, parameters.blur_pixels)
    away = np.zeros_like(fine) if level else fine
    light = inside * (inner + inner_slope * away) + (1.0 - inside) * (outer + outer_slope * away)
    code = codes_of_light(light, gamma)
    radius = parameters.radius_pixels / _FINE_STEP_PIXELS
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
