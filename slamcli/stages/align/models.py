"""Transform models: plane transforms by closed-form least squares, many samples at a time.

Rigid and similarity: Umeyama, PAMI 13, 1991, in the plane, where the rotation is the angle of a
complex number and a reflection cannot come out. Homography: the normalised direct linear
transform, Hartley, PAMI 19, 1997.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from slamcli.core.arrays import BoolArray, Complex128Array, Float64Array
from slamcli.core.config import TransformModel

# Three points closer to one line than this share of their extent determine no transform
# [guarded by tests/stages/test_align.py].
_MIN_RELATIVE_AREA = 0.02


@dataclass(frozen=True, slots=True)
class Model:
    """A kind of plane transform.

    Attributes
    ----------
    name : str
    sample_size : int
        Point pairs that determine it.
    isometric : bool
        Whether it keeps distances, so that residuals are equal in both frames.
    fit : function of (K, n, 2) points in a, (K, n, 2) in b, and (K, n) weights of the pairs
        Returns (K, 3, 3) ``a_from_b``; nan where the points do not determine it.
    """

    name: TransformModel
    sample_size: int
    isometric: bool
    fit: Callable[[Float64Array, Float64Array, Float64Array], Float64Array]


def fit_rigid_motion(a: Float64Array, b: Float64Array, weights: Float64Array) -> Float64Array:
    """Fit rotation and translation: (K, n, 2) points each, (K, 3, 3) a_from_b."""
    centre_a, centre_b, rotation = _complex_regression(a, b, weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _from_complex(rotation / np.abs(rotation), centre_a, centre_b)


def fit_similarity(a: Float64Array, b: Float64Array, weights: Float64Array) -> Float64Array:
    """Fit rotation, scale and translation: (K, n, 2) points each, (K, 3, 3) a_from_b."""
    centre_a, centre_b, rotation = _complex_regression(a, b, weights)
    complex_b = b[..., 0] + 1j * b[..., 1]
    moment = np.sum(weights * np.abs(complex_b - centre_b[:, None]) ** 2, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _from_complex(rotation / moment, centre_a, centre_b)


def fit_affine(a: Float64Array, b: Float64Array, weights: Float64Array) -> Float64Array:
    """Fit a linear map and a translation: (K, n, 2) points each, (K, 3, 3) a_from_b."""
    centre_a, centre_b = _weighted_centre(a, weights), _weighted_centre(b, weights)
    centred_a, centred_b = a - centre_a[:, None], b - centre_b[:, None]
    weighted_b = centred_b * weights[..., None]
    cross = centred_a.transpose(0, 2, 1) @ weighted_b
    moment = centred_b.transpose(0, 2, 1) @ weighted_b
    determinant = moment[:, 0, 0] * moment[:, 1, 1] - moment[:, 0, 1] ** 2
    adjugate = np.empty_like(moment)
    adjugate[:, 0, 0], adjugate[:, 1, 1] = moment[:, 1, 1], moment[:, 0, 0]
    adjugate[:, 0, 1] = adjugate[:, 1, 0] = -moment[:, 0, 1]
    matrix = _identities(len(a))
    with np.errstate(divide="ignore", invalid="ignore"):
        matrix[:, :2, :2] = cross @ adjugate / determinant[:, None, None]
    matrix[:, :2, 2] = centre_a - np.einsum("kij,kj->ki", matrix[:, :2, :2], centre_b)
    return matrix


def fit_homography(a: Float64Array, b: Float64Array, weights: Float64Array) -> Float64Array:
    """Fit a homography by the normalised DLT: (K, n, 2) points each, (K, 3, 3) a_from_b."""
    normalising_a, normalising_b = _normalising(a), _normalising(b)
    u = _apply(normalising_a, a)
    p = _apply(normalising_b, b)
    homogeneous = np.concatenate([p, np.ones((*p.shape[:2], 1))], axis=2)
    nothing = np.zeros_like(homogeneous)
    equations = np.concatenate(
        [
            np.concatenate([homogeneous, nothing, -u[:, :, :1] * homogeneous], axis=2),
            np.concatenate([nothing, homogeneous, -u[:, :, 1:] * homogeneous], axis=2),
        ],
        axis=1,
    )
    root = np.sqrt(weights / weights.max(axis=1, keepdims=True))
    equations *= np.concatenate([root, root], axis=1)[..., None]
    usable = np.isfinite(equations).all(axis=(1, 2))
    equations[~usable] = 0.0
    # The smallest eigenvector of the 9x9 normal matrix: precise enough after normalisation, and
    # far cheaper than a singular value decomposition of all rows.
    _, vectors = np.linalg.eigh(equations.transpose(0, 2, 1) @ equations)
    normalised = vectors[:, :, 0].reshape(-1, 3, 3)
    back = _identities(len(a))
    scale_a = normalising_a[:, 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        back[:, 0, 0] = back[:, 1, 1] = 1.0 / scale_a
        back[:, :2, 2] = -normalising_a[:, :2, 2] / scale_a[:, None]
        matrix: Float64Array = back @ normalised @ normalising_b
        # The scale of a homography is free; w is made 1 at b's centre, which is surely in view.
        depth = np.einsum("ki,ki->k", matrix[:, 2, :2], b.mean(axis=1)) + matrix[:, 2, 2]
        matrix /= depth[:, None, None]
    matrix[~usable] = np.nan
    return matrix


MODELS: Final[dict[TransformModel, Model]] = {
    "rigid": Model("rigid", 2, True, fit_rigid_motion),  # noqa: FBT003
    "similarity": Model("similarity", 2, False, fit_similarity),  # noqa: FBT003
    "affine": Model("affine", 3, False, fit_affine),  # noqa: FBT003
    "homography": Model("homography", 4, False, fit_homography),  # noqa: FBT003
}


def sound_samples(
    a: Float64Array, b: Float64Array, thresholds: Float64Array, model: Model
) -> BoolArray:
    """Return which minimal samples can determine a transform at all.

    Parameters
    ----------
    a, b : (K, m, 2) point pairs
    thresholds : (K, m)
        How far each pair may err; points closer together than that determine no direction.
    model : Model

    Returns
    -------
    (K,) bool: no two points (nearly) in one place, no three on one line, none mirrored, and for a
    model that keeps distances, distances kept.
    """
    sound = np.ones(len(a), dtype=np.bool_)
    size = model.sample_size
    for first in range(size):
        for second in range(first + 1, size):
            length_a = np.linalg.norm(a[:, first] - a[:, second], axis=1)
            length_b = np.linalg.norm(b[:, first] - b[:, second], axis=1)
            slack = thresholds[:, first] + thresholds[:, second]
            sound &= (length_a > slack) & (length_b > slack)
            if model.isometric:
                sound &= np.abs(length_a - length_b) <= slack
            for third in range(second + 1, size):
                corners = [first, second, third]
                area_a, area_b = _relative_area(a[:, corners]), _relative_area(b[:, corners])
                sound &= np.minimum(np.abs(area_a), np.abs(area_b)) > _MIN_RELATIVE_AREA
                sound &= area_a * area_b > 0.0
    return sound


def _complex_regression(
    a: Float64Array, b: Float64Array, weights: Float64Array
) -> tuple[Complex128Array, Complex128Array, Complex128Array]:
    """Return both centres and the sum of a times conjugate b, points taken as complex numbers."""
    complex_a, complex_b = a[..., 0] + 1j * a[..., 1], b[..., 0] + 1j * b[..., 1]
    total = weights.sum(axis=1)
    centre_a = np.sum(weights * complex_a, axis=1) / total
    centre_b = np.sum(weights * complex_b, axis=1) / total
    product = (complex_a - centre_a[:, None]) * np.conj(complex_b - centre_b[:, None])
    return centre_a, centre_b, np.sum(weights * product, axis=1)


def _weighted_centre(points: Float64Array, weights: Float64Array) -> Float64Array:
    total = weights.sum(axis=1)[:, None]
    return np.asarray(np.sum(weights[..., None] * points, axis=1) / total)


def _from_complex(
    factor: Complex128Array,
    centre_a: Complex128Array,
    centre_b: Complex128Array,
) -> Float64Array:
    """Return the (K, 3, 3) matrices of z -> factor (z - centre_b) + centre_a."""
    offset = centre_a - factor * centre_b
    matrix = _identities(len(factor))
    matrix[:, 0, 0] = matrix[:, 1, 1] = factor.real
    matrix[:, 1, 0], matrix[:, 0, 1] = factor.imag, -factor.imag
    matrix[:, 0, 2], matrix[:, 1, 2] = offset.real, offset.imag
    return matrix


def _identities(count: int) -> Float64Array:
    return np.tile(np.eye(3), (count, 1, 1))


def _normalising(points: Float64Array) -> Float64Array:
    """Return (K, 3, 3) similarities that bring (K, n, 2) points to centre 0, mean distance 1."""
    centre = points.mean(axis=1)
    distance = np.linalg.norm(points - centre[:, None], axis=2).mean(axis=1)
    matrix = _identities(len(points))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / distance
        matrix[:, 0, 0] = matrix[:, 1, 1] = scale
        matrix[:, :2, 2] = -scale[:, None] * centre
    return matrix


def _apply(matrix: Float64Array, points: Float64Array) -> Float64Array:
    """Map (K, n, 2) points by (K, 3, 3) transforms without perspective."""
    mapped: Float64Array = points @ matrix[:, :2, :2].transpose(0, 2, 1) + matrix[:, None, :2, 2]
    return mapped


def _relative_area(corners: Float64Array) -> Float64Array:
    """Return (K,) twice the signed area of (K, 3, 2) triangles over their longest side squared."""
    side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    third = other - side
    longest = np.max([np.sum(edge**2, axis=1) for edge in (side, other, third)], axis=0)
    cross = side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]
    area: Float64Array = cross / np.maximum(longest, np.finfo(float).tiny)
    return area
