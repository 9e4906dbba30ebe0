"""How sure an adjustment is: of the camera, of each pose, and of how much the frames rock."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse.linalg import SuperLU

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.stages.adjustment.equations import Block, BundleState, Layout, held_values, weights
from slamcli.stages.adjustment.projection import (
    CAMERA_PARAMETERS,
    FRAME_PARAMETERS,
    POSE_PARAMETERS,
)

# By how much frames vary at least and at first: pitch, roll (rad), log height.
_MIN_ROCKING = np.array([2e-5, 2e-5, 1e-4])
_COLUMNS_AT_ONCE = 240


def rocking_seen(state: BundleState, layout: Layout, factor: SuperLU) -> Float64Array:
    """Return the sigmas that the frames' estimated rocking, and its uncertainty, speak for."""
    held = held_values(layout, state)
    marginals = _marginals(layout, factor, slice(POSE_PARAMETERS, FRAME_PARAMETERS))
    squares = [
        held[layout.of_frame(place)[POSE_PARAMETERS:]] ** 2 + np.diag(marginal)
        for place, marginal in enumerate(marginals)
    ]
    return np.asarray(np.maximum(np.sqrt(np.mean(squares, axis=0)), _MIN_ROCKING))


def camera_covariance(
    layout: Layout,
    state: BundleState,
    factor: SuperLU,
    blocks: Sequence[Block],
    prior: Float64Array,
    scale: float,
) -> Float64Array:
    """Return the camera's covariance, enlarged to what the matches' disagreement speaks for.

    Errors of one pair are alike (an uneven floor), and so are those of pairs that share a frame
    (its blur, its rocking): the sandwich of White (Econometrica 48, 1980) with each pair's whole
    gradient as one error, and with pairs that share a frame as dependent (Fafchamps and Gubert,
    Journal of Development Economics 83, 2007); for every parameter the larger counts.
    """
    columns = _inverse_columns(factor, layout.count, np.arange(CAMERA_PARAMETERS))
    told = np.diag(columns[:CAMERA_PARAMETERS])
    by_pair = np.zeros(CAMERA_PARAMETERS)
    by_frame = _pulls_of_priors(layout, columns, prior * held_values(layout, state))
    by_prior = np.sum(by_frame**2, axis=0)
    places = {index: place for place, index in enumerate(layout.frames)}
    for block in blocks:
        weighted = block.jacobian * weights(block, scale)[:, None, None]
        gradient = np.einsum("nik,ni->k", weighted, block.residual)
        pull = columns[block.unknowns].T @ np.where(layout.free[block.unknowns], gradient, 0.0)
        by_pair += pull**2
        for index in block.frames:
            by_frame[places[index]] += pull
    few = len(layout.frames) / max(len(layout.frames) - 1, 1)
    alike = few * np.maximum(by_pair + by_prior, np.sum(by_frame**2, axis=0) - by_pair)
    grown = np.sqrt(np.maximum(alike / np.maximum(told, 1e-30), 1.0))
    free = layout.free[:CAMERA_PARAMETERS]
    covariance = columns[:CAMERA_PARAMETERS] * np.outer(grown, grown)
    return np.asarray(np.where(np.outer(free, free), covariance, 0.0))


def _pulls_of_priors(layout: Layout, columns: Float64Array, pulls: Float64Array) -> Float64Array:
    """Return (frames, 7): how what holds each frame's rocking pulls at the camera."""
    frames = range(len(layout.frames))
    return np.array([columns[own].T @ pulls[own] for own in map(layout.of_frame, frames)])


def pose_covariances(layout: Layout, factor: SuperLU) -> dict[int, Float64Array]:
    """Return the (3, 3) covariance of every frame's pose, in its own axes; zero where held."""
    marginals = _marginals(layout, factor, slice(0, POSE_PARAMETERS))
    covariances = {}
    for place, index in enumerate(layout.frames):
        own = layout.free[layout.of_frame(place)[:POSE_PARAMETERS]]
        covariances[index] = np.where(np.outer(own, own), marginals[place], 0.0)
    return covariances


def _marginals(layout: Layout, factor: SuperLU, parts: slice) -> list[Float64Array]:
    """Return every frame's own block of the covariance."""
    size = parts.stop - parts.start
    at_once = max(1, _COLUMNS_AT_ONCE // size)
    found = []
    for start in range(0, len(layout.frames), at_once):
        places = range(start, min(start + at_once, len(layout.frames)))
        wanted = np.concatenate([layout.of_frame(place)[parts] for place in places])
        columns = _inverse_columns(factor, layout.count, wanted)
        for number in range(len(places)):
            block = slice(number * size, (number + 1) * size)
            found.append(columns[wanted[block], block])
    return found


def _inverse_columns(factor: SuperLU, count: int, wanted: Int64Array) -> Float64Array:
    unit = np.zeros((count, len(wanted)))
    unit[wanted, np.arange(len(wanted))] = 1.0
    return np.asarray(factor.solve(unit), np.float64)
