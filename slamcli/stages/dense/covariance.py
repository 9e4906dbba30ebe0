"""The covariance of a photometric fit: as gradients and noise predict it, and as residuals show it.

The prediction rests on the gradients that both views share and on assumed noise; whether a motion
is determined at all is decided by it. The covariance itself is the cluster-robust one (Liang and
Zeger, Biometrika 73, 1986): the residuals' slopes are summed over blocks of the view, and these
sums, whatever correlates the residuals within a block, have the variance that they show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import PyramidLevel, SampledLevel
from slamcli.stages.dense import pyramid, sparse_view

_MIN_INFORMATION = 1e-8
# Information below this many sigmas of what noise adds up to is taken for none: two, and gradients
# of noise correlate over about six pixels, so that they add up to more than independent ones
# [guarded by tests/registration/test_plain_lines.py, benchmarks/robustness.py: textureless-course;
# sigmas by benchmarks/sigmas.py: NEES].
_CHANCE_SIGMAS = 5.0
# Aliasing of an edge in the camera's pixels, and the blocks of a JPEG, move with the camera and not
# with the floor: this share of an edge's gradient along it is no information, or of all information
# where that is less: what rocking and motion have in common moves nothing far along an edge
# [guarded by benchmarks/robustness.py: jpeg, textureless-course; rocking on the course: NEES of
# links 0.3 in the median by all information alone, 2.4].
_ALIASING_SHARE = 0.01
# Of a camera that rocks: the smallest sigma of a motion over its largest
# [benchmarks/robustness.py, rocking: RPE 0.70 mm on asphalt and 1.44 on the course without].
_MIN_SIGMA_RATIO = 0.1
# Side of a block, pixels of the finest level: more than blur and texture correlate over, few enough
# for many blocks a view [benchmarks/sigmas.py: NEES 2.2 to 5 at 16 and 32, up to twice that at 64].
_BLOCK_PIXELS = 32.0
# The prediction counts as much as this many blocks do.
_PRIOR_BLOCKS = 2.0
# Points by which the leverage of the blocks is measured, and how much of it counts: a block that
# determines a direction alone would make it open [the sample, NEES of links 8.4 without, 5.1].
_LEVERAGE_POINTS = 2000
_LEVERAGE_SHARE = 0.9
# Points at which a level that is read at single places is read anew for its gradients.
_SPARSE_GRADIENTS = 1500


@dataclass(frozen=True, slots=True, eq=False)
class FitState:
    """The unknowns: the motion, and the deviations of pitch, roll and height in either frame.

    Attributes
    ----------
    a_from_b : Pose2
    mounting_a, mounting_b : (K,) float64
        Radians and metres; (0,) for a steady camera.
    """

    a_from_b: Pose2
    mounting_a: Float64Array
    mounting_b: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """The last Gauss-Newton step on a level.

    Attributes
    ----------
    state : FitState
    slopes : (K, N) float64
    places : Places
        Of the points in b's level.
    points : (N, 2) float64
        On b's floor, metres.
    residual, weight : (N,) float64
        Before the step; the weight by the noise of the residuals themselves.
    prior : (K, K) float64
        Information of the priors.
    """

    state: FitState
    slopes: Float64Array
    places: pyramid.Places
    points: Float64Array
    residual: Float64Array
    weight: Float64Array
    prior: Float64Array

    def sampled(self, count: int) -> NormalEquations:
        """Return the equations of some of the points, evenly taken, which represent all."""
        step = -(-len(self.points) // count)
        some = slice(None, None, step)
        return NormalEquations(
            self.state,
            self.slopes[:, some],
            self.places.part(some),
            self.points[some],
            self.residual[some],
            self.weight[some] * step,
            self.prior,
        )


def covariances_of(
    b: PyramidLevel | SampledLevel,
    solved: NormalEquations,
    along_edges: Float64Array | None = None,
) -> tuple[Float64Array, Float64Array] | None:
    """Return the (3, 3) covariance of the motion, predicted and as the residuals show it.

    The noise of one view has gradients too, which would pass for information about a motion along a
    plain line; in the product with the other view's, whose noise is independent, they cancel on
    average. None where the information is not finite.

    Parameters
    ----------
    b : PyramidLevel or SampledLevel
    solved : NormalEquations
    along_edges : (K, N) float64 or None
        The slopes, if the gradients were turned by a right angle; None for a steady camera, of
        whose motions no two have most in common.
    """
    central = _about_the_middle(solved)
    some = solved.sampled(_SPARSE_GRADIENTS) if isinstance(b, SampledLevel) else solved
    products = _products(b, some, along_edges)
    found = _seen_information(products, central, len(some.points))
    if found is None:
        return None
    seen, scales = found
    prior = central.T @ solved.prior @ central * scales
    inverse = invert(seen + prior + _MIN_INFORMATION * np.eye(len(seen)))
    scores = _score_covariance(blocks(b, some.points), some, products.own)
    scores = central.T @ scores @ central * scales
    predicted = (inverse * scales)[:3, :3]
    shown = (inverse @ (scores + prior) @ inverse * scales)[:3, :3]
    if along_edges is not None:
        shown = _without_narrow_axes(shown, float(solved.points.std(axis=0).max()))
    back = central[:3, :3]
    return np.asarray(back @ predicted @ back.T), np.asarray(back @ shown @ back.T)


def _without_narrow_axes(covariance: Float64Array, reach_metres: float) -> Float64Array:
    """Return a (3, 3) covariance whose smallest sigmas are no less than a share of the largest.

    The links of a frame have its tilt and height in common. As if their errors were independent,
    the graph would place it where their uncertain axes, which are nearly parallel, intersect.
    """
    units = np.array([1.0, 1.0, 1.0 / reach_metres])
    values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
    values = np.maximum(values, values[-1] * _MIN_SIGMA_RATIO**2)
    wide: Float64Array = (vectors * values) @ vectors.T * np.outer(units, units)
    return wide


def _about_the_middle(solved: NormalEquations) -> Float64Array:
    """Return (K, K): unknowns about the middle of the overlap, where turn and shift are apart."""
    central = np.eye(len(solved.slopes))
    middle = solved.points.mean(axis=0)
    central[:2, 2] = middle[1], -middle[0]
    return central


@dataclass(frozen=True, slots=True, eq=False)
class _Products:
    """Weighted products of the residuals' slopes by either view's gradients, summed: (K, K) each.

    Attributes
    ----------
    own : (K, K) float64
        Of the slopes by view a's gradients, with themselves.
    shared : (K, K) float64
        With those by view b's.
    others : (K, K) float64
        Of those by view b's, with themselves.
    along : (K, K) float64 or None
        Of the slopes by view a's gradients turned by a right angle, with themselves.
    """

    own: Float64Array
    shared: Float64Array
    others: Float64Array
    along: Float64Array | None


def _products(
    b: PyramidLevel | SampledLevel, solved: NormalEquations, along_edges: Float64Array | None
) -> _Products:
    points, count = solved.points, len(solved.slopes)
    right, up = sparse_view.slopes_at(b, solved.places)
    both = np.empty((count + 3, len(points)))
    both[:count] = solved.slopes
    both[count], both[count + 1] = -right, -up
    both[count + 2] = both[count + 1] * points[:, 0] - both[count] * points[:, 1]
    products = (both * solved.weight) @ both.T
    # Gain, offset and rocking change the residuals alike in either.
    by_b = [count, count + 1, count + 2, *range(3, count)]
    along = None if along_edges is None else (along_edges * solved.weight) @ along_edges.T
    own, shared, others = products[:count, :count], products[:count], products[by_b]
    return _Products(own, shared[:, by_b], others[:, by_b], along)


def _seen_information(
    products: _Products, central: Float64Array, count: int
) -> tuple[Float64Array, Float64Array] | None:
    """Return (K, K) information that both views show, scaled, and the scales; None if infinite."""
    own, shared, others = (
        central.T @ product @ central
        for product in (products.own, products.shared, products.others)
    )
    unshared = (own - shared - shared.T + others) / 2.0
    scale = 1.0 / np.sqrt(np.maximum(np.diag(own), 1e-12))
    scales = np.outer(scale, scale)
    values, vectors = np.linalg.eigh((shared + shared.T) / 2.0 * scales)
    if not np.isfinite(values).all():
        return None
    # The products of the two views' noise, and of either's with what both show, add up by chance to
    # this; along an unobservable direction they are all there is.
    noise = np.maximum(np.einsum("ki,kl,li->i", vectors, unshared * scales, vectors), 0.0)
    chance = np.sqrt((2.0 * np.maximum(values, 0.0) * noise + noise**2) / count)
    aliasing = np.full(len(values), _ALIASING_SHARE)
    if products.along is not None:
        along = central.T @ products.along @ central * scales
        aliasing *= np.minimum(np.einsum("ki,kl,li->i", vectors, along, vectors), 1.0)
    chance = np.maximum(_CHANCE_SIGMAS * chance, aliasing)
    return (vectors * np.maximum(values - chance, 0.0)) @ vectors.T, scales


def blocks(b: PyramidLevel | SampledLevel, points: Float64Array) -> Int64Array:
    """Return (N,): the number of the block of the view that each of (N, 2) points lies in."""
    side = _BLOCK_PIXELS * b.metres_per_pixel
    column, row = (np.floor(places / side).astype(np.int64) for places in points.T)
    row -= row.min()
    block: Int64Array = (column - column.min()) * (row.max() + 1) + row
    return block


def _score_covariance(
    block: Int64Array, solved: NormalEquations, information: Float64Array
) -> Float64Array:
    """Return the (K, K) covariance of the sum of the residuals' weighted slopes, by blocks.

    A block that determines a direction alone has no residual in it, whatever its error: its sum is
    that of the residuals that a fit without the block would leave there (the jackknife; Bell and
    McCaffrey, Survey Methodology 28, 2002).
    """
    weighted = solved.weight * solved.residual
    sums = np.array([np.bincount(block, weights=slopes * weighted) for slopes in solved.slopes])
    count = float(np.count_nonzero(np.bincount(block)))
    inflated = _without_own_block(sums, block, solved, information)
    shown = inflated @ inflated.T * (count / max(count - 1.0, 1.0))
    covariance: Float64Array = (count * shown + _PRIOR_BLOCKS * information) / (
        count + _PRIOR_BLOCKS
    )
    return covariance


def _without_own_block(
    sums: Float64Array, block: Int64Array, solved: NormalEquations, information: Float64Array
) -> Float64Array:
    """Return (K, B) sums of residuals by blocks, as a fit without each block would leave them."""
    step = -(-len(block) // _LEVERAGE_POINTS)
    some, slopes = block[::step], solved.slopes[:, ::step]
    order = np.argsort(some, kind="stable")
    first = np.flatnonzero(np.diff(some[order], prepend=-1))
    part = slopes[:, order]
    products = (part * solved.weight[::step][order])[:, None] * part[None]
    own = np.zeros((sums.shape[1], *information.shape))
    own[some[order][first]] = step * np.add.reduceat(products, first, axis=2).transpose(2, 0, 1)
    # Of the same points: a block's share is then never more than all there is.
    whole = own.sum(axis=0) + solved.prior
    share = own @ invert(whole + _MIN_INFORMATION * np.diag(np.diag(whole)))
    left = np.eye(len(sums)) - _LEVERAGE_SHARE * share
    return np.asarray(np.linalg.solve(left, sums.T[..., None])[..., 0].T, np.float64)
