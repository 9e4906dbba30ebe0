"""Sides where the camera's own step puts them, among what texture and sharpening do to edges.

A blurred step of light, encoded, sharpened and sampled as the picture's own pixels are, is fitted
to the mean profiles of all sides. How far each profile then is from that step, by weights that
leave out the texture and the noise of either side (generalised least squares), is where its edge
lies: a sharpening mask or a side along the pixel grid, whose profiles all have one phase, move it
no more, and a spot of the floor hardly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.lens import Lens, undistort_points
from slamcli.core.light import Gamma, light_of_codes, light_of_fractions
from slamcli.stages.square.candidates import inner_radius
from slamcli.stages.square.edges import EdgedQuad, assemble, corners_of_sides
from slamcli.stages.square.lines import Side, fit_side_robustly
from slamcli.stages.square.profiles import edge_model, locate_edges
from slamcli.stages.square.side_profiles import SideProfiles, read_side
from slamcli.stages.square.step_model import (
    COMMON_COUNT,
    SIDE_COUNT,
    StepParameters,
    codes_of_step,
    fine_distances,
)

_REACH_PIXELS = 8.0
_MAX_BOW_PIXELS = 0.5
# A usual camera's mask before anything is measured: its radius within a third more or less, and
# how much it may sharpen [benchmarks/calibration_targets.py].
_USUAL_RADIUS_PIXELS, _RADIUS_LOG_SIGMA = 1.0, 0.3
_SHARE_SIGMA = 1.0
# Of how the light changes per pixel outwards, as a share of the step.
_SLOPE_SIGMA_SHARE = 0.02
# Of one side's blur over the common one [benchmarks/calibration_targets.py: errors in sigmas of
# 50 squares' roll 0.81 at 0.1 and 1.09 with one blur for all].
_LOG_BLUR_SIGMA = 0.1
_MAX_SHARE = 4.0
_RADIUS_RANGE_PIXELS = (0.6, 4.0)
_BLUR_RANGE_PIXELS = (0.05, 5.0)
_START_SHARE, _START_BLUR_PIXELS = 0.3, 0.7
_FITS = 2
# Of numeric derivatives: by a place, pixels, and by share, log radius and blur.
_STEP = 0.02
# How far one profile's step may be from the mean one, as a factor.
_RELATIVE_RANGE = (0.5, 2.0)
_STEP_PROFILES = 5
# Error of the correction, as a share of it, of cameras that sharpen in another way.
_MODEL_ERROR_SHARE = 0.2
# A side whose mean profile the model leaves more of is not corrected by it: other edges, shadows.
_MAX_UNEXPLAINED_SHARE = 0.08


@dataclass(frozen=True, slots=True, eq=False)
class _Replaced:
    """A side where the model puts it.

    Attributes
    ----------
    side : Side
    bias_pixels : float
        How far outside an edge is seen whose weights are alike to either side.
    common_slopes : (3,) float64
        How the side moves outwards with share, log radius and blur.
    shape_sigma_pixels : float
        Of its place, by what the model's shape leaves unexplained.
    """

    side: Side
    bias_pixels: float
    common_slopes: Float64Array
    shape_sigma_pixels: float


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
    quad = corners_of_sides(edged.sides)
    half = min(_REACH_PIXELS, 0.5 * inner_radius(quad))
    light = np.asarray(light_of_fractions(codes.astype(np.float64), gamma), np.float32)
    read = [read_side((codes, light), quad, side, lens, half) for side in enumerate(edged.sides)]
    seen = [profiles for profiles in read if profiles is not None]
    if not seen:
        return edged
    fitted, common_covariance = _fit(seen, gamma)
    replaced = {
        profiles.index: _replace_side(
            profiles, fitted, row, edged.sides[profiles.index], lens, gamma
        )
        for row, profiles in enumerate(seen)
        if _explained(profiles, fitted, row, gamma)
    }
    if not replaced:
        return edged
    sides = [
        replaced[index] if index in replaced else _like_others(side, edged.sides, replaced)
        for index, side in enumerate(edged.sides)
    ]
    slopes = np.array([side.common_slopes for side in sides])
    biases = _MODEL_ERROR_SHARE * np.array([side.bias_pixels for side in sides])
    shapes = np.diag([side.shape_sigma_pixels**2 for side in sides])
    covariance = slopes @ common_covariance @ slopes.T + np.outer(biases, biases) + shapes
    corrected = assemble([side.side for side in sides], lens, covariance)
    return replace(corrected, support=edged.support)


def _like_others(side: Side, sides: tuple[Side, ...], replaced: dict[int, _Replaced]) -> _Replaced:
    """Return a side that shows something else as well, moved as the others are."""
    shifts = [
        float(sides[index].line[:2] @ (other.side.centre - sides[index].centre))
        for index, other in replaced.items()
    ]
    shift = float(np.mean(shifts))
    slopes = np.mean([other.common_slopes for other in replaced.values()], axis=0)
    moved = replace(side, centre=side.centre + shift * side.line[:2])
    return _Replaced(moved, shift, slopes, float(np.ptp(shifts)))


def _replace_side(
    profiles: SideProfiles,
    fitted: StepParameters,
    row: int,
    known: Side,
    lens: Lens,
    gamma: Gamma,
) -> _Replaced:
    """Fit a line to where the profiles have the model's step."""
    fine = fine_distances(float(profiles.offsets[-1]))

    def modelled(vector: Float64Array) -> Float64Array:
        parameters = StepParameters.from_vector(vector)
        codes = codes_of_step(parameters, row, profiles.widths, fine, gamma)
        return light_of_fractions(codes, gamma)

    # By the place of the side, and by share, log radius and blur.
    start = fitted.vector
    changes = _STEP * np.eye(len(start))[[COMMON_COUNT + SIDE_COUNT * row, *range(COMMON_COUNT)]]
    slopes = np.column_stack(
        [
            profiles.mean_from_fine @ (modelled(start + change) - modelled(start - change))
            for change in changes
        ]
    ) / (2.0 * _STEP)
    # What an edge and its two sides look like, weighted by the texture and noise around them.
    design = edge_model(profiles.offsets, profiles.blur_pixels)
    weighted = np.linalg.solve(profiles.light_covariance, design)
    inside, outside, *_, shift = np.linalg.solve(design.T @ weighted, weighted.T)
    shift = shift / float(shift @ slopes[:, 0])
    left = profiles.light - profiles.sample(modelled(start))
    place, inner, outer = (float(value) for value in fitted.sides[row, :3])
    # The mean of neighbours has the step between the two sides with less noise.
    relative = 1.0 + left @ (inside - outside) / (inner - outer)
    relative = uniform_filter1d(relative, _STEP_PROFILES, mode="nearest")
    places = place + left @ shift / np.clip(relative, *_RELATIVE_RANGE)
    points = undistort_points(lens, profiles.origins + profiles.normals * places[:, None])
    side = fit_side_robustly(points, profiles.total, lens.image_size[0])
    codes = codes_of_step(fitted, row, profiles.widths, fine, gamma, level=True)
    level = light_of_fractions(codes, gamma)
    misplaced = locate_edges(profiles.sample(level), profiles.offsets).places - place
    return _Replaced(
        side=replace(side, bow_pixels=known.bow_pixels, blur_pixels=known.blur_pixels),
        bias_pixels=float(np.mean(misplaced)),
        common_slopes=-shift @ slopes[:, 1:],
        shape_sigma_pixels=profiles.shape_sigma * float(np.linalg.norm(shift)),
    )


def _explained(profiles: SideProfiles, fitted: StepParameters, row: int, gamma: Gamma) -> bool:
    """Return whether the model explains nearly all of a side's mean profile."""
    left = profiles.codes - _mean_codes(profiles, fitted, row, gamma)
    return float(np.abs(left).max()) < _MAX_UNEXPLAINED_SHARE * float(np.ptp(profiles.codes))


def _mean_codes(
    profiles: SideProfiles, parameters: StepParameters, row: int, gamma: Gamma
) -> Float64Array:
    """Return the mean profile that the model has for a side, in codes."""
    fine = fine_distances(float(profiles.offsets[-1]))
    return profiles.mean_from_fine @ codes_of_step(parameters, row, profiles.widths, fine, gamma)


def _fit(sides: list[SideProfiles], gamma: Gamma) -> tuple[StepParameters, Float64Array]:
    """Return the parameters that explain the sides' mean profiles best (generalised least squares).

    Beside them the (3, 3) covariance of share, log radius and blur.
    """
    observed = sum(len(side.codes) for side in sides)
    whitening = [np.linalg.inv(np.linalg.cholesky(side.code_covariance)) for side in sides]
    table = light_of_codes(gamma)
    rows = np.zeros((len(sides), SIDE_COUNT))
    for row, side in zip(rows, sides, strict=True):
        row[1:3] = np.interp(side.codes[[0, -1]], np.arange(256), table)
    contrasts = np.abs(rows[:, 1:2] - rows[:, 2:3]) + 1.0
    start = StepParameters(_START_SHARE, _USUAL_RADIUS_PIXELS, _START_BLUR_PIXELS, rows).vector
    low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    radii = np.log(_RADIUS_RANGE_PIXELS)
    limits = [(0.0, _MAX_SHARE), radii, _BLUR_RANGE_PIXELS]
    low[:COMMON_COUNT], high[:COMMON_COUNT] = np.array(limits).T
    # No side is darker than black.
    low[COMMON_COUNT + 1 :: SIDE_COUNT] = low[COMMON_COUNT + 2 :: SIDE_COUNT] = -1e-6
    sigma = 1.0

    # Slow to load, and needed only here.
    from scipy.optimize import least_squares

    def misfit(values: Float64Array) -> Float64Array:
        parameters = StepParameters.from_vector(values)
        left = [
            whiten @ (_mean_codes(side, parameters, row, gamma) - side.codes) / sigma
            for row, (side, whiten) in enumerate(zip(sides, whitening, strict=True))
        ]
        usual = (values[1] - math.log(_USUAL_RADIUS_PIXELS)) / _RADIUS_LOG_SIGMA
        slopes = parameters.sides[:, 3:5] / (_SLOPE_SIGMA_SHARE * contrasts)
        blurs = parameters.sides[:, 5] / _LOG_BLUR_SIGMA
        return np.concatenate([*left, [values[0] / _SHARE_SIGMA, usual], slopes.ravel(), blurs])

    for _ in range(_FITS):
        fit = least_squares(misfit, start, bounds=(low, high), x_scale="jac", max_nfev=40)
        start = np.asarray(fit.x, np.float64)
        freedom = max(observed - len(start), 1)
        sigma = max(sigma * math.sqrt(float(np.sum(fit.fun[:observed] ** 2)) / freedom), 1.0)
    jacobian = np.asarray(fit.jac, np.float64)
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), np.float64)
    return StepParameters.from_vector(start), covariance[:COMMON_COUNT, :COMMON_COUNT]
