"""Profiles of one side, in codes and in light, with all that a model of its step is fitted by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.core.camera.lens import Lens
from slamcli.stages.square.lines import Side
from slamcli.stages.square.profiles import Profiles, locate_edges, read_profiles
from slamcli.stages.square.step_model import FINE_STEP_PIXELS, fine_distances
from slamcli.stages.square.texture import CLEAR_SHARE, correlated_profiles, texture_covariance

_MIN_SAMPLES = 9
# Profiles whose step is not like that of most show something else.
_STEP_RANGE = (0.6, 1.6)
_MAX_PLACE_PIXELS = 1.5
# A side along the pixels' rows or columns sees no shorter edge of them.
_MIN_WIDTH_PIXELS = 0.02
# Of one profile, at least, in codes and in light: rounding to 8 bits.
_MIN_CODE_SIGMA, _MIN_LIGHT_SIGMA = 0.3, 0.1
# Of a mean profile, as a share of its step: what neither blur nor mask explains, at least. In codes
# lens blur of another shape is easily taken for a mask, in light it hardly moves an edge
# [benchmarks/calibration_targets.py: worst corner of 50 squares 0.17 px at 0.003 in light, 0.29 at
# 0.01; tests/stages/test_square.py: a sharpened corner 0.07 px off at 0.003 in codes].
_CODE_SHAPE_SHARE, _LIGHT_SHAPE_SHARE = 0.015, 0.003


@dataclass(frozen=True, slots=True, eq=False)
class SideProfiles:
    """One side's profiles, and where the pixels lie that they were interpolated from.

    Attributes
    ----------
    index : int
        Of the side.
    origins, normals : (N, 2) float64
        Of the profiles, in pixels of the picture.
    offsets : (T,) float64
    light : (N, T) float64
    codes : (T,) float64
        Mean profile.
    light_covariance, code_covariance : (T, T) float64
        Of the mean profile: texture, noise, and what the model's shape leaves.
    shape_sigma : float
        That last share of `light_covariance`, one sigma.
    blur_pixels : float
        Standard deviation of the blur in light.
    distances, weights : (N, T, 4) float64
        Of the four pixels around each sample: how far outside the side, and their shares.
    mean_from_fine : (T, F) float64
        The mean profile of a function of the distance on the fine grid.
    widths : (float, float)
        Of a pixel across the side: the longer and the shorter of its edges as seen that way.
    total : int
        Profiles that were read, with those left out.
    """

    index: int
    origins: Float64Array
    normals: Float64Array
    offsets: Float64Array
    light: Float64Array
    codes: Float64Array
    light_covariance: Float64Array
    code_covariance: Float64Array
    shape_sigma: float
    blur_pixels: float
    distances: Float64Array
    weights: Float64Array
    mean_from_fine: Float64Array
    widths: tuple[float, float]
    total: int

    def sample(self, function: Float64Array) -> Float64Array:
        """Return (N, T) profiles of a function of the distance on the fine grid."""
        fine = fine_distances(float(self.offsets[-1]))
        return np.asarray(np.sum(np.interp(self.distances, fine, function) * self.weights, axis=2))


def read_side(
    images: tuple[Float32Array, Float32Array],
    quad: Float64Array,
    side: tuple[int, Side],
    lens: Lens,
    half_length: float,
) -> SideProfiles | None:
    """Return a side's profiles, or None where too few show its step.

    Parameters
    ----------
    images : two of (H, W) float32
        The encoded picture, and its light.
    quad : (4, 2)
        Undistorted pixels.
    side : (int, Side)
        Which of its sides, and what is known of it.
    lens : Lens
    half_length : float
        Pixels.
    """
    index, known = side
    profiles, in_light = (
        read_profiles(image, quad, index, lens, half_length, known.bow_pixels) for image in images
    )
    if profiles is None or in_light is None or len(profiles.offsets) < _MIN_SAMPLES:
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
    across = np.sort(np.abs(profiles.normals.mean(axis=0)))
    codes, light = profiles.values[kept], in_light.values[kept]
    blur = locate_edges(light, profiles.offsets).blur_pixels
    code_covariance, _ = _mean_covariance(
        codes, profiles.offsets, blur, (_MIN_CODE_SIGMA, _CODE_SHAPE_SHARE)
    )
    light_covariance, shape = _mean_covariance(
        light, profiles.offsets, blur, (_MIN_LIGHT_SIGMA, _LIGHT_SHAPE_SHARE)
    )
    return SideProfiles(
        index=index,
        origins=profiles.origins[kept],
        normals=profiles.normals[kept],
        offsets=profiles.offsets,
        light=light,
        codes=codes.mean(axis=0),
        light_covariance=light_covariance,
        code_covariance=code_covariance,
        shape_sigma=shape,
        blur_pixels=blur,
        distances=distances,
        weights=weights,
        mean_from_fine=_mean_operator(
            distances, weights, fine_distances(float(profiles.offsets[-1]))
        ),
        widths=(float(across[1]), max(float(across[0]), _MIN_WIDTH_PIXELS)),
        total=int(profiles.usable.sum()),
    )


def _mean_covariance(
    values: Float64Array, offsets: Float64Array, blur: float, model: tuple[float, float]
) -> tuple[Float64Array, float]:
    """Return the covariance of the mean of (N, T) profiles, and the sigma of its model's shape.

    `model` is the least sigma of a value, and what the model leaves as a share of the step.
    """
    min_sigma, shape_share = model
    floor = values[:, offsets > CLEAR_SHARE * offsets[-1]]
    share = min(correlated_profiles(floor) / len(values), 1.0)
    shape = max(min_sigma, shape_share * float(np.ptp(values.mean(axis=0))))
    own = (share * min_sigma**2 + shape**2) * np.eye(len(offsets))
    return share * texture_covariance(values, offsets, blur) + own, shape


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
    place = np.clip((distances - fine[0]) / FINE_STEP_PIXELS, 0.0, len(fine) - 1.001)
    low = place.astype(np.intp)
    share = place - low
    count = distances.shape[1]
    sample = np.broadcast_to(np.arange(count)[None, :, None], low.shape)
    operator = np.zeros((count, len(fine)))
    np.add.at(operator, (sample, low), weights * (1.0 - share))
    np.add.at(operator, (sample, low + 1), weights * share)
    return operator / len(distances)
