"""Uncertainty of a bundle adjustment: covariances of camera and poses, sigmas of the rocking."""

from __future__ import annotations

import numpy as np
from scipy.sparse.linalg import SuperLU

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.stages.adjustment.equations import (
    BundleState,
    Layout,
    Linearisation,
    prior_residuals,
)
from slamcli.stages.adjustment.projection import (
    CAMERA_PARAMETERS,
    FRAME_PARAMETERS,
    POSE_PARAMETERS,
)

# Frames vary by this much at least: pitch, roll (rad), log height.
# [guarded by benchmarks/self_calibration.py]
_MIN_ROCKING = np.array([2e-5, 2e-5, 1e-4])
_COLUMNS_AT_ONCE = 240


def estimate_rocking(state: BundleState, layout: Layout, factor: SuperLU) -> Float64Array:
    """Return the sigmas (3,) of the rocking, from the frames' estimates and their uncertainty.

    The M step of expectation maximisation (see `solver`).
    """
    deviation = prior_residuals(layout, state)
    marginals = _marginals(layout, factor, slice(POSE_PARAMETERS, FRAME_PARAMETERS))
    squares = [
        deviation[layout.of_frame(position)[POSE_PARAMETERS:]] ** 2 + np.diag(marginal)
        for position, marginal in enumerate(marginals)
    ]
    return np.asarray(np.maximum(np.sqrt(np.mean(squares, axis=0)), _MIN_ROCKING))


def camera_covariance(
    layout: Layout,
    state: BundleState,
    factor: SuperLU,
    found: Linearisation,
    prior: Float64Array,
    scale: float,
) -> Float64Array:
    """Return the camera's covariance (7, 7), robust against correlated errors of the matches.

    Errors of one pair are correlated (an uneven floor), and so are those of pairs with a frame in
    common (its blur, its rocking): the sandwich of White (Econometrica 48, 1980) with each pair's
    gradient as one error, and with pairs that share a frame as dependent (Fafchamps and Gubert,
    Journal of Development Economics 83, 2007); for every parameter the larger variance counts.
    """
    columns = _inverse_columns(factor, layout.count, np.arange(CAMERA_PARAMETERS))
    nominal = np.diag(columns[:CAMERA_PARAMETERS])
    by_pair = np.zeros(CAMERA_PARAMETERS)
    by_frame = _influence_of_priors(layout, columns, prior * prior_residuals(layout, state))
    by_prior = np.sum(by_frame**2, axis=0)
    for number, (weighted, _, residual) in enumerate(found.by_pair(scale)):
        unknowns = found.unknowns[number]
        gradient = np.where(layout.free[unknowns], weighted @ residual, 0.0)
        influence = columns[unknowns].T @ gradient
        by_pair += influence**2
        by_frame[found.pairs[number]] += influence
    small_sample = len(layout.frames) / max(len(layout.frames) - 1, 1)
    clustered = small_sample * np.maximum(by_pair + by_prior, np.sum(by_frame**2, axis=0) - by_pair)
    inflation = np.sqrt(np.maximum(clustered / np.maximum(nominal, 1e-30), 1.0))
    free = layout.free[:CAMERA_PARAMETERS]
    covariance = columns[:CAMERA_PARAMETERS] * np.outer(inflation, inflation)
    return np.asarray(np.where(np.outer(free, free), covariance, 0.0))


def _influence_of_priors(
    layout: Layout, columns: Float64Array, gradient: Float64Array
) -> Float64Array:
    """Return (frames, 7): the influence on the camera of the prior of each frame's rocking."""
    frames = range(len(layout.frames))
    return np.array([columns[own].T @ gradient[own] for own in map(layout.of_frame, frames)])


def pose_covariances(layout: Layout, factor: SuperLU) -> dict[int, Float64Array]:
    """Return the (3, 3) covariance of every frame's pose, in its own axes; zero where fixed."""
    marginals = _marginals(layout, factor, slice(0, POSE_PARAMETERS))
    covariances = {}
    for position, index in enumerate(layout.frames):
        own = layout.free[layout.of_frame(position)[:POSE_PARAMETERS]]
        covariances[index] = np.where(np.outer(own, own), marginals[position], 0.0)
    return covariances


def _marginals(layout: Layout, factor: SuperLU, parts: slice) -> list[Float64Array]:
    """Return every frame's own block of the covariance."""
    size = parts.stop - parts.start
    at_once = max(1, _COLUMNS_AT_ONCE // size)
    found = []
    for start in range(0, len(layout.frames), at_once):
        positions = range(start, min(start + at_once, len(layout.frames)))
        wanted = np.concatenate([layout.of_frame(position)[parts] for position in positions])
        columns = _inverse_columns(factor, layout.count, wanted)
        for number in range(len(positions)):
            block = slice(number * size, (number + 1) * size)
            found.append(columns[wanted[block], block])
    return found


def _inverse_columns(factor: SuperLU, count: int, wanted: Int64Array) -> Float64Array:
    """Return some columns (count, W) of the inverse of the factorised normal matrix."""
    unit = np.zeros((count, len(wanted)))
    unit[wanted, np.arange(len(wanted))] = 1.0
    return np.asarray(factor.solve(unit), np.float64)
