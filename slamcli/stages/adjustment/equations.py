"""The equations of the bundle adjustment: unknowns, residuals, priors and normal matrix."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix

from slamcli.core.arrays import BoolArray, Float64Array, Int64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.robust import GEMAN_MCCLURE_SIGMAS, geman_mcclure_weights
from slamcli.stages.adjustment.frame_poses import FramePose
from slamcli.stages.adjustment.observations import Observations
from slamcli.stages.adjustment.projection import (
    CAMERA_PARAMETERS,
    FRAME_PARAMETERS,
    POSE_PARAMETERS,
    product,
)

# [All thresholds here are guarded by benchmarks/self_calibration.py.]
_MIN_SCALE = 0.3
# Priors: no calibration is worse than about this, and what the matches do not observe must not
# diverge. Log focal length, radial coefficients, pitch, roll, principal point (in focal lengths).
_CAMERA_SIGMAS = np.array([0.15, 0.4, 0.4, 0.1, 0.1, 0.02, 0.02])


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The order of the unknowns: the camera's first, then frame by frame."""

    frames: tuple[int, ...]
    free: BoolArray

    @property
    def count(self) -> int:
        """How many unknowns there are."""
        return CAMERA_PARAMETERS + FRAME_PARAMETERS * len(self.frames)

    def of_frame(self, position: int) -> Int64Array:
        """Return (6,): the unknowns of the frame at a position in `frames`."""
        start = CAMERA_PARAMETERS + FRAME_PARAMETERS * position
        return np.arange(start, start + FRAME_PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class BundleState:
    """The current estimate: camera, poses, camera change in all, floor unevenness (m, 1 sigma)."""

    calibration: Calibration
    poses: dict[int, FramePose]
    change: Float64Array
    unevenness_metres: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """All matches that are seen, linearised about a state, in standard deviations.

    Attributes
    ----------
    pairs : (P, 2) int64
        Positions of each pair's frames.
    unknowns : (P, 19) int64
        Each pair's indices in the vector of all unknowns.
    starts : (P + 1,) int64
        Where each pair's matches begin, and the last ones end.
    residual : (2, M) float64
    jacobian : (2, 19, M) float64
    median : (M,) float64
        Of the length of a residual, were it a standard normal one.
    plain, by_rise : (2, M) float64
        The residual, and its derivative by the height of the floor at the spot (1/m), both as they
        are on an even floor.
    """

    pairs: Int64Array
    unknowns: Int64Array
    starts: Int64Array
    residual: Float64Array
    jacobian: Float64Array
    median: Float64Array
    plain: Float64Array
    by_rise: Float64Array

    def by_pair(self, scale: float) -> Iterator[tuple[Float64Array, Float64Array, Float64Array]]:
        """Yield each pair's weighted Jacobian and its Jacobian (19, 2n), and its residual (2n,)."""
        weights = self.weights(scale)
        for start, end in pairwise(self.starts.tolist()):
            own = np.ascontiguousarray(self.jacobian[:, :, start:end].transpose(1, 0, 2))
            weighted = own * weights[start:end]
            size = 2 * (end - start)
            residual = self.residual[:, start:end].reshape(size)
            yield weighted.reshape(-1, size), own.reshape(-1, size), residual

    def squares(self, scale: float) -> Float64Array:
        """Return (M,): the squared length of each residual, as a share of the scale's."""
        squares: Float64Array = np.sum(self.residual**2, axis=0) / scale**2
        return squares

    def weights(self, scale: float) -> Float64Array:
        """Return (M,): the robust weight of each match (Geman and McClure)."""
        weights = geman_mcclure_weights(self.squares(scale) / GEMAN_MCCLURE_SIGMAS**2)
        return weights / scale**2


def free_unknowns(
    frames: Sequence[int],
    anchors: Sequence[int],
    camera_free: BoolArray,
    rocking_sigmas: Float64Array,
) -> BoolArray:
    """Return (K,) bool: which unknowns are estimated."""
    fixed = set(anchors)
    by_frame = [
        np.concatenate([np.full(POSE_PARAMETERS, index not in fixed), rocking_sigmas > 0.0])
        for index in frames
    ]
    return np.concatenate([camera_free, *by_frame])


def prior_information(layout: Layout, sigmas: Float64Array) -> Float64Array:
    """Return the information (K,) of each unknown's prior, whose mean is zero; 0 without one."""
    rocking = np.where(sigmas > 0.0, 1.0 / np.maximum(sigmas, 1e-12) ** 2, 0.0)
    by_frame = np.concatenate([np.zeros(POSE_PARAMETERS), rocking])
    return np.concatenate([_CAMERA_SIGMAS**-2, np.tile(by_frame, len(layout.frames))])


def prior_residuals(layout: Layout, state: BundleState) -> Float64Array:
    """Return (K,): the deviation of each unknown with a prior from zero."""
    values = np.zeros(layout.count)
    values[:CAMERA_PARAMETERS] = state.change
    height = state.calibration.height_metres
    for position, index in enumerate(layout.frames):
        rocking = state.poses[index].rocking
        values[layout.of_frame(position)[POSE_PARAMETERS:]] = (
            rocking.pitch_radians,
            rocking.roll_radians,
            math.log1p(rocking.height_metres / height),
        )
    return values


def linearise(state: BundleState, observations: Observations, layout: Layout) -> Linearisation:
    """Return all matches linearised about a state."""
    calibration, poses = state.calibration, [state.poses[index] for index in layout.frames]
    moved = observations.transfer(calibration, poses)
    plain = observations.whitened(moved.pixels - observations.pixels_b)
    # Where the floor lies higher, both cameras are nearer to it.
    heights = calibration.height_metres + np.array([pose.rocking.height_metres for pose in poses])
    a, b = heights[observations.pairs[observations.pair].T]
    by_rise = observations.whitened(-moved.by_a[:, -1] / a - moved.by_b[:, -1] / b)
    shrink = _shrinking(by_rise * state.unevenness_metres)
    jacobian = np.concatenate([moved.by_camera, moved.by_a, moved.by_b], axis=1)
    whitening = product(shrink, observations.whitening)
    seen = np.isfinite(moved.pixels).all(axis=0)
    return Linearisation(
        observations.pairs,
        _unknowns(observations.pairs, layout),
        np.searchsorted(observations.pair[seen], np.arange(len(observations.pairs) + 1)),
        product(shrink, plain[:, None])[:, 0, seen],
        product(whitening, jacobian)[:, :, seen],
        observations.median[seen],
        plain[:, seen],
        by_rise[:, seen],
    )


def _unknowns(pairs: Int64Array, layout: Layout) -> Int64Array:
    """Return (P, 19): the unknowns of every pair's camera and two frames."""
    camera = np.tile(np.arange(CAMERA_PARAMETERS), (len(pairs), 1))
    by_frame = CAMERA_PARAMETERS + np.arange(FRAME_PARAMETERS * len(layout.frames))
    of_frames = by_frame.reshape(-1, FRAME_PARAMETERS)[pairs]
    return np.concatenate([camera, of_frames.reshape(len(pairs), -1)], axis=1)


def _shrinking(spread: Float64Array) -> Float64Array:
    """Return (2, 2, N): the inverse root of ``I + s s^T`` for (2, N) vectors s."""
    squared = np.sum(spread**2, axis=0)
    share = (1.0 - 1.0 / np.sqrt(1.0 + squared)) / np.maximum(squared, 1e-12)
    outer: Float64Array = np.eye(2)[:, :, None] - share * (spread[:, None] * spread[None, :])
    return outer


def estimate_unevenness(found: Linearisation, scale: float) -> float:
    """Return the floor's unevenness (m): the excess of residuals along that direction."""
    length = np.maximum(np.linalg.norm(found.by_rise, axis=0), 1e-9)
    along = np.sum(found.plain * (found.by_rise / length), axis=0)
    sensitive = length > np.median(length)
    # The median of a squared normal number is 0.455 times its variance.
    variance = (along[sensitive] / length[sensitive]) ** 2
    even = (scale / length[sensitive]) ** 2
    return math.sqrt(max(float(np.median(variance)) / 0.455 - float(np.median(even)), 0.0))


def residual_scale(found: Linearisation) -> float:
    """Return how many times longer residuals are than their sigmas predict (median)."""
    lengths = np.linalg.norm(found.residual, axis=0) / found.median
    return max(float(np.median(lengths)), _MIN_SCALE)


def total_cost(
    found: Linearisation, scale: float, prior: Float64Array, deviation: Float64Array
) -> float:
    """Return the robust cost of the residuals, and of the deviation (K,) from the prior."""
    squares = found.squares(scale)
    robust = np.sum(squares / (1.0 + squares / GEMAN_MCCLURE_SIGMAS**2))
    return float(np.sum(prior * deviation**2)) + float(robust)


def normal_equations(
    found: Linearisation,
    scale: float,
    prior: Float64Array,
    layout: Layout,
    state: BundleState,
) -> tuple[csc_matrix, Float64Array]:
    """Return the normal matrix (K, K), sparse, and the gradient (K,); identity where fixed."""
    gradient = prior * prior_residuals(layout, state)
    blocks = np.empty((*found.unknowns.shape, found.unknowns.shape[1]))
    for number, (weighted, jacobian, residual) in enumerate(found.by_pair(scale)):
        blocks[number] = weighted @ jacobian.T
        gradient[found.unknowns[number]] += weighted @ residual
    free = layout.free[found.unknowns]
    both = free[:, :, None] & free[:, None, :]
    rows, columns = (
        np.broadcast_to(unknowns, blocks.shape)[both]
        for unknowns in (found.unknowns[:, :, None], found.unknowns[:, None, :])
    )
    diagonal = np.arange(layout.count)
    values = np.concatenate([blocks[both], np.where(layout.free, np.maximum(prior, 1e-9), 1.0)])
    places = np.concatenate([rows, diagonal]), np.concatenate([columns, diagonal])
    normal = coo_matrix((values, places), (layout.count, layout.count))
    return normal.tocsc(), np.where(layout.free, gradient, 0.0)
