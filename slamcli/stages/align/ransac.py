"""Random sample consensus: the transform that most matches agree with.

Fischler and Bolles, CACM 24, 1981, with the 2015 thesis's tie-break: of two hypotheses with
equally many inliers the one with the smaller net distance wins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.stages.align.models import Model, sound_samples

# Few at first: among mostly right matches no more are needed.
_FIRST_HYPOTHESES = 64
_MAX_HYPOTHESES_AT_ONCE = 512
# Hypotheses times matches scored at once: what fits a processor's cache.
_MAX_RESIDUALS_AT_ONCE = 200_000
_MAX_REFITS = 10
# Below it a transform maps the plane onto a line, or mirrors it.
_MIN_DETERMINANT = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """Result of RANSAC: the transform and the matches that agree with it.

    Attributes
    ----------
    a_from_b : (3, 3) float64
        Refitted to the inliers by least squares.
    inliers : (M,) bool
    residuals : (M,) float64
        Of all matches; for a model that changes scale the larger of those in a and in b.
    iterations : int
        Hypotheses drawn.
    """

    a_from_b: Float64Array
    inliers: BoolArray
    residuals: Float64Array
    iterations: int


def ransac(
    points_a: Float64Array,
    points_b: Float64Array,
    model: Model,
    thresholds: float | Float64Array,
    *,
    confidence: float = 0.999,
    max_iterations: int = 5000,
    seed: int = 0,
) -> Consensus | None:
    """Find the transform that most of (M, 2) point pairs agree with.

    A residual is measured in both frames and the larger one counts, so that a transform that
    shrinks everything to a point gains nothing.

    Parameters
    ----------
    points_a, points_b : (M, 2) float64
        Matched points, in one unit.
    model : Model
    thresholds : float or (M,)
        A pair is an inlier when its residual is below this.
    confidence : float
        Sampling stops when, at the inlier ratio found, an all-inlier sample has been drawn with
        this probability.
    max_iterations : int
    seed : int
        Of the samples; equal input gives equal output.

    Returns
    -------
    Consensus or None
        None when no sample determines a transform that any further match agrees with.
    """
    count = len(points_a)
    if count < model.sample_size:
        return None
    limits = np.broadcast_to(np.asarray(thresholds, dtype=np.float64), (count,))
    generator = np.random.default_rng(seed)
    best, best_rank = None, (model.sample_size, 0.0)
    drawn, needed, chunk = 0, max_iterations, _FIRST_HYPOTHESES
    while drawn < needed:
        chunk = min(chunk, max(1, _MAX_RESIDUALS_AT_ONCE // count), max_iterations - drawn)
        sample = generator.integers(0, count, size=(chunk, model.sample_size))
        drawn += chunk
        hypotheses = _hypotheses(points_a[sample], points_b[sample], limits[sample], model)
        candidate, rank = _best(hypotheses, points_a, points_b, limits, model)
        if candidate is not None and rank > best_rank:
            best, best_rank = candidate, rank
            needed = min(max_iterations, _needed(rank[0] / count, model.sample_size, confidence))
        chunk = min(2 * chunk, _MAX_HYPOTHESES_AT_ONCE)
    if best is None:
        return None
    return _refit(best, points_a, points_b, limits, model, drawn)


def residuals_of(
    hypotheses: Float64Array,
    points_a: Float64Array,
    points_b: Float64Array,
    model: Model,
) -> Float64Array:
    """Return (K, M) distances between (M, 2) matched points under (K, 3, 3) ``a_from_b``.

    For a model that changes scale, the larger of the distances in a and in b; inf behind the
    horizon of a homography.
    """
    forward = _distances(hypotheses, points_b, points_a)
    if model.isometric:
        return forward
    return np.maximum(forward, _distances(_inverses(hypotheses), points_a, points_b))


def _hypotheses(
    sample_a: Float64Array,
    sample_b: Float64Array,
    limits: Float64Array,
    model: Model,
) -> Float64Array:
    sound = sound_samples(sample_a, sample_b, limits, model)
    fitted = model.fit(sample_a[sound], sample_b[sound], np.ones_like(limits[sound]))
    fitted = fitted[np.isfinite(fitted).all(axis=(1, 2))]
    return np.asarray(fitted[np.linalg.det(fitted) > _MIN_DETERMINANT])


def _best(
    hypotheses: Float64Array,
    points_a: Float64Array,
    points_b: Float64Array,
    limits: Float64Array,
    model: Model,
) -> tuple[Float64Array | None, tuple[int, float]]:
    """Return the best hypothesis with its rank: inliers, then minus their net distance."""
    if not len(hypotheses):
        return None, (0, 0.0)
    residuals = residuals_of(hypotheses, points_a, points_b, model)
    agree = residuals < limits
    inliers = agree.sum(axis=1)
    net_distance = np.where(agree, residuals, 0.0).sum(axis=1)
    winner = int(np.lexsort((net_distance, -inliers))[0])
    return hypotheses[winner], (int(inliers[winner]), -float(net_distance[winner]))


def _needed(inlier_ratio: float, sample_size: int, confidence: float) -> int:
    """Return how many samples contain an all-inlier one with the given probability."""
    all_inliers = inlier_ratio**sample_size
    if all_inliers >= 1.0:
        return 1
    return math.ceil(math.log1p(-confidence) / math.log1p(-all_inliers))


def _refit(
    a_from_b: Float64Array,
    points_a: Float64Array,
    points_b: Float64Array,
    limits: Float64Array,
    model: Model,
    iterations: int,
) -> Consensus | None:
    """Fit to the inliers again until they stay the same, each weighted by its own threshold."""
    weights = 1.0 / limits**2
    residuals = residuals_of(a_from_b[None], points_a, points_b, model)[0]
    inliers = residuals < limits
    for _ in range(_MAX_REFITS):
        fitted = model.fit(points_a[inliers][None], points_b[inliers][None], weights[inliers][None])
        if not np.isfinite(fitted).all():
            return None
        a_from_b = fitted[0]
        residuals = residuals_of(fitted, points_a, points_b, model)[0]
        agree = residuals < limits
        if np.array_equal(agree, inliers):
            break
        inliers = agree
        if np.count_nonzero(inliers) < model.sample_size:
            return None
    return Consensus(a_from_b, inliers, residuals, iterations)


def _distances(
    hypotheses: Float64Array,
    source: Float64Array,
    target: Float64Array,
) -> Float64Array:
    """Return (K, M) distances of mapped (M, 2) source points from their targets."""
    homogeneous = np.vstack([source.T, np.ones(len(source))])
    mapped = (hypotheses.reshape(-1, 3) @ homogeneous).reshape(-1, 3, len(source))
    x, y, w = mapped[:, 0], mapped[:, 1], mapped[:, 2]
    if np.any(hypotheses[:, 2, :2]):
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.hypot(x / w - target[:, 0], y / w - target[:, 1])
        return np.where(w > 0.0, distance, np.inf)
    return np.hypot(x - target[:, 0], y - target[:, 1])


def _inverses(hypotheses: Float64Array) -> Float64Array:
    """Return the inverses of (K, 3, 3) transforms, with w kept positive where they map to.

    The adjugate is the inverse times the determinant, and exists for singular matrices too.
    """
    first, second, third = hypotheses[:, :, 0], hypotheses[:, :, 1], hypotheses[:, :, 2]
    adjugate = np.stack(
        [np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=1
    )
    determinant = np.einsum("ki,ki->k", first, adjugate[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse: Float64Array = adjugate / determinant[:, None, None]
    return inverse
