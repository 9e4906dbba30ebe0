"""The camera and all poses that explain every match at once: bundle adjustment over a plane.

Levenberg-Marquardt on the reprojection error with analytic Jacobians and a redescending kernel
(Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000). The unknowns are the camera's, shared
by all frames, and each frame's pose with what its pitch, roll and height differ by; those are held
near zero by how much they vary, which the data tell too (expectation maximisation for variance
components: Dempster, Laird and Rubin, 1977). The plane's scale is not observable: it is held by the
calibration's height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix, diags
from scipy.sparse.linalg import splu

from slamcli.core.geometry import Pose2
from slamcli.core.records import Rocking
from slamcli.stages.adjustment.projection import (
    CAMERA_PARAMETERS,
    FRAME_PARAMETERS,
    POSE_PARAMETERS,
    View,
    changed,
    transfer_with_jacobians,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray
    from scipy.sparse.linalg import SuperLU

    from slamcli.core.records import Calibration
    from slamcli.stages.adjustment.patches import Matches

_MOST_ITERATIONS = 40
_MOST_RETRIES = 6
_CONVERGED = 1e-3
# While it is still being learnt how much frames vary, steps towards the end would be wasted.
_LEARNING_ITERATIONS = 3
# Geman and McClure's scale in sigmas; see stages.align.rigid.
_KERNEL_SIGMAS = 3.0
# Median length of a normal error in one direction, and in two.
_MEDIAN_ONE, _MEDIAN_TWO = 0.6745, math.sqrt(2.0 * math.log(2.0))
_LINE_RATIO = 0.3
# By how much frames vary at least and at first: pitch, roll (rad), log height.
_LEAST_ROCKING = np.array([2e-5, 2e-5, 1e-4])
FIRST_ROCKING = np.array([0.004, 0.004, 0.01])
_LEAST_SCALE = 0.3
# No calibration is worse than about this, and what the matches leave open must not run away: log
# focal length, radial coefficients, pitch, roll, principal point (in focal lengths).
_CAMERA_SIGMAS = np.array([0.15, 0.4, 0.4, 0.1, 0.1, 0.02, 0.02])
_COLUMNS_AT_ONCE = 240


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """What explains the matches best.

    Attributes
    ----------
    calibration : Calibration
    views : dict of int to View
        By frame index.
    camera_change : (7,) float64
        Of log focal length, the first two radial coefficients, pitch, roll and principal point (in
        focal lengths), in all.
    camera_covariance : (7, 7) float64
        Zero where a parameter was held.
    pose_covariances : dict of int to (3, 3) float64
        Of x, y (m), theta (rad), in the robot's own axes; zero for a frame that defines its map.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and log height vary from frame to frame.
    scale : float
        How many times larger residuals are than the matches' sigmas said.
    unevenness_metres : float
        By how much the floor lies higher here and lower there, one sigma.
    """

    calibration: Calibration
    views: dict[int, View]
    camera_change: NDArray[np.float64]
    camera_covariance: NDArray[np.float64]
    pose_covariances: dict[int, NDArray[np.float64]]
    rocking_sigmas: NDArray[np.float64]
    scale: float
    unevenness_metres: float


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """Where each unknown stands in the vector of all: the camera's first, then frame by frame."""

    frames: tuple[int, ...]
    free: NDArray[np.bool_]

    @property
    def count(self) -> int:
        return CAMERA_PARAMETERS + FRAME_PARAMETERS * len(self.frames)

    def of_frame(self, place: int) -> NDArray[np.int64]:
        start = CAMERA_PARAMETERS + FRAME_PARAMETERS * place
        return np.arange(start, start + FRAME_PARAMETERS)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """Where the unknowns stand, and how uneven the floor is (m, one sigma)."""

    calibration: Calibration
    views: dict[int, View]
    change: NDArray[np.float64]
    unevenness_metres: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """One pair of frames, linearised, all in standard deviations.

    Attributes
    ----------
    unknowns : (19,) int
        Places in the vector of all unknowns.
    residual : (N, 2) float64
    jacobian : (N, 2, 19) float64
    median : (N,) float64
        Of the length of a residual, were it a standard normal one.
    plain, by_rise : (N, 2) float64
        The residual, and what a metre by which the floor lies higher at the spot changes it by, as
        they are on an even floor.
    """

    unknowns: NDArray[np.int64]
    residual: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    median: NDArray[np.float64]
    plain: NDArray[np.float64]
    by_rise: NDArray[np.float64]


def adjust(
    calibration: Calibration,
    views: Mapping[int, View],
    matches: Sequence[Matches],
    anchors: Sequence[int],
    *,
    camera_free: NDArray[np.bool_],
    rocking_sigmas: NDArray[np.float64],
    learning_rounds: int = 0,
) -> Adjustment:
    """Estimate camera, poses and rocking together.

    Parameters
    ----------
    calibration : Calibration
        The start; its height stays.
    views : mapping of frame index to View
        The start of every frame in `matches`.
    matches : sequence of Matches
    anchors : sequence of int
        Frames whose poses stay: one for each connected map.
    camera_free : (7,) bool
        Which of log focal length, two radial coefficients, pitch, roll and the principal point's
        column and row are estimated.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and log height vary from frame to frame; zeros: not at all.
    learning_rounds : int
        So many times those, and how uneven the floor is, are estimated anew from what was found;
        six suffice from any start.
    """
    frames = tuple(sorted({m.a for m in matches} | {m.b for m in matches}))
    layout = _Layout(frames, _free(frames, anchors, camera_free, rocking_sigmas))
    state = _State(
        calibration, {index: views[index] for index in frames}, np.zeros(CAMERA_PARAMETERS)
    )
    rounds = 1 + (learning_rounds if np.any(rocking_sigmas) else 0)
    sigmas = rocking_sigmas
    for number in range(rounds):
        prior = _prior(layout, sigmas)
        learning = 0 < number < rounds - 1
        iterations = _LEARNING_ITERATIONS if learning else _MOST_ITERATIONS
        state, scale, factor, blocks = _descend(state, matches, layout, prior, iterations)
        if number + 1 < rounds:
            sigmas = _rocking_seen(state, layout, factor)
            state = replace(state, unevenness_metres=_unevenness_seen(blocks, scale))
    return Adjustment(
        state.calibration,
        state.views,
        state.change,
        _camera_covariance(layout, state, factor, blocks, prior, scale),
        _pose_covariances(layout, factor),
        sigmas,
        scale,
        state.unevenness_metres,
    )


def residual_lengths(
    calibration: Calibration, views: Mapping[int, View], matches: Sequence[Matches]
) -> NDArray[np.float64]:
    """Return the length of every match's residual, in its own sigmas, all pairs in their order."""
    lengths = []
    for pair in matches:
        there = transfer_with_jacobians(
            calibration, views[pair.a], views[pair.b], pair.pixels_a
        ).pixels
        residual = np.einsum("nij,nj->ni", pair.whitening, there - pair.pixels_b)
        lengths.append(np.linalg.norm(residual, axis=1))
    return np.concatenate(lengths) if lengths else np.zeros(0)


def _free(
    frames: Sequence[int],
    anchors: Sequence[int],
    camera_free: NDArray[np.bool_],
    rocking_sigmas: NDArray[np.float64],
) -> NDArray[np.bool_]:
    held = set(anchors)
    by_frame = [
        np.concatenate([np.full(POSE_PARAMETERS, index not in held), rocking_sigmas > 0.0])
        for index in frames
    ]
    return np.concatenate([camera_free, *by_frame])


def _prior(layout: _Layout, sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information (K,) that holds each unknown near zero."""
    rocking = np.where(sigmas > 0.0, 1.0 / np.maximum(sigmas, 1e-12) ** 2, 0.0)
    by_frame = np.concatenate([np.zeros(POSE_PARAMETERS), rocking])
    return np.concatenate([_CAMERA_SIGMAS**-2, np.tile(by_frame, len(layout.frames))])


def _held(layout: _Layout, state: _State) -> NDArray[np.float64]:
    """Return (K,): how far each unknown that is held near zero stands from it."""
    values = np.zeros(layout.count)
    values[:CAMERA_PARAMETERS] = state.change
    height = state.calibration.height_metres
    for place, index in enumerate(layout.frames):
        rocking = state.views[index].rocking
        values[layout.of_frame(place)[POSE_PARAMETERS:]] = (
            rocking.pitch_radians,
            rocking.roll_radians,
            math.log1p(rocking.height_metres / height),
        )
    return values


def _descend(
    state: _State,
    matches: Sequence[Matches],
    layout: _Layout,
    prior: NDArray[np.float64],
    iterations: int,
) -> tuple[_State, float, SuperLU, list[_Block]]:
    """Run Levenberg-Marquardt; return the state, the residuals' scale, and its last equations."""
    damping = 1e-4
    blocks = _linearise(state, matches, layout)
    scale = _scale(blocks)
    for _ in range(iterations):
        cost = _cost(blocks, scale, prior, _held(layout, state))
        normal, gradient = _normal_equations(blocks, scale, prior, layout, state)
        diagonal = normal.diagonal()
        for _ in range(_MOST_RETRIES):
            damped = splu((normal + diags(damping * diagonal)).tocsc())
            step = np.where(layout.free, -damped.solve(gradient), 0.0)
            tried = _moved(state, layout, step)
            new_blocks = _linearise(tried, matches, layout)
            if _cost(new_blocks, scale, prior, _held(layout, tried)) <= cost:
                damping = max(damping / 10.0, 1e-9)
                break
            damping *= 10.0
        else:
            break
        expected = float(step @ (normal @ step))
        state, blocks = tried, new_blocks
        before, scale = scale, _scale(blocks)
        if expected < _CONVERGED and abs(scale / before - 1.0) < 1e-3:
            break
    normal, _ = _normal_equations(blocks, scale, prior, layout, state)
    return state, scale, splu(normal), blocks


def _linearise(state: _State, matches: Sequence[Matches], layout: _Layout) -> list[_Block]:
    places = {index: place for place, index in enumerate(layout.frames)}
    blocks = []
    for pair in matches:
        moved = transfer_with_jacobians(
            state.calibration, state.views[pair.a], state.views[pair.b], pair.pixels_a
        )
        seen = np.isfinite(moved.pixels).all(axis=1)
        whitening = pair.whitening[seen]
        difference = moved.pixels[seen] - pair.pixels_b[seen]
        jacobian = np.concatenate([moved.by_camera, moved.by_a, moved.by_b], axis=2)[seen]
        unknowns = np.concatenate(
            [
                np.arange(CAMERA_PARAMETERS),
                layout.of_frame(places[pair.a]),
                layout.of_frame(places[pair.b]),
            ]
        )
        known = np.linalg.norm(whitening, axis=2).min(axis=1)
        along = np.linalg.norm(whitening, axis=2).max(axis=1)
        plain = np.einsum("nij,nj->ni", whitening, difference)
        # Where the floor lies higher, both cameras are nearer to it.
        heights = [
            state.calibration.height_metres + state.views[index].rocking.height_metres
            for index in (pair.a, pair.b)
        ]
        rise = -moved.by_a[seen, :, -1] / heights[0] - moved.by_b[seen, :, -1] / heights[1]
        by_rise = np.einsum("nij,nj->ni", whitening, rise)
        shrink = _shrinking(by_rise * state.unevenness_metres)
        blocks.append(
            _Block(
                unknowns,
                np.einsum("nij,nj->ni", shrink, plain),
                shrink @ whitening @ jacobian,
                np.where(known < _LINE_RATIO * along, _MEDIAN_ONE, _MEDIAN_TWO),
                plain,
                by_rise,
            )
        )
    return blocks


def _shrinking(spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 2, 2): the inverse root of ``I + s s^T`` for (N, 2) vectors s."""
    squared = np.einsum("ni,ni->n", spread, spread)
    share = (1.0 - 1.0 / np.sqrt(1.0 + squared)) / np.maximum(squared, 1e-12)
    outer = spread[:, :, None] * spread[:, None, :]
    return np.asarray(np.eye(2) - share[:, None, None] * outer)


def _unevenness_seen(blocks: Sequence[_Block], scale: float) -> float:
    """Return how uneven the floor is: what residuals vary more by in the one way that shows it."""
    plain = np.concatenate([block.plain for block in blocks])
    by_rise = np.concatenate([block.by_rise for block in blocks])
    length = np.maximum(np.linalg.norm(by_rise, axis=1), 1e-9)
    along = np.einsum("ni,ni->n", plain, by_rise / length[:, None])
    telling = length > np.median(length)
    # The median of a squared normal number is 0.455 times its variance.
    variance = (along[telling] / length[telling]) ** 2
    even = (scale / length[telling]) ** 2
    return math.sqrt(max(float(np.median(variance)) / 0.455 - float(np.median(even)), 0.0))


def _scale(blocks: Sequence[_Block]) -> float:
    lengths = [np.linalg.norm(block.residual, axis=1) / block.median for block in blocks]
    return max(float(np.median(np.concatenate(lengths))), _LEAST_SCALE)


def _squares(block: _Block, scale: float) -> NDArray[np.float64]:
    squares: NDArray[np.float64] = np.sum(block.residual**2, axis=1) / scale**2
    return squares


def _cost(
    blocks: Sequence[_Block],
    scale: float,
    prior: NDArray[np.float64],
    held: NDArray[np.float64],
) -> float:
    total = float(np.sum(prior * held**2))
    for block in blocks:
        squares = _squares(block, scale)
        total += float(np.sum(squares / (1.0 + squares / _KERNEL_SIGMAS**2)))
    return total


def _weights(block: _Block, scale: float) -> NDArray[np.float64]:
    weights: NDArray[np.float64] = (1.0 + _squares(block, scale) / _KERNEL_SIGMAS**2) ** -2
    return weights / scale**2


def _normal_equations(
    blocks: Sequence[_Block],
    scale: float,
    prior: NDArray[np.float64],
    layout: _Layout,
    state: _State,
) -> tuple[csc_matrix, NDArray[np.float64]]:
    """Return the normal matrix (K, K), sparse, and the gradient (K,); identity where held."""
    gradient = prior * _held(layout, state)
    rows, columns, values = [], [], []
    for block in blocks:
        weighted = block.jacobian * _weights(block, scale)[:, None, None]
        local = np.einsum("nik,nil->kl", weighted, block.jacobian)
        gradient[block.unknowns] += np.einsum("nik,ni->k", weighted, block.residual)
        row, column = np.meshgrid(block.unknowns, block.unknowns, indexing="ij")
        both = layout.free[row] & layout.free[column]
        rows.append(row[both])
        columns.append(column[both])
        values.append(local[both])
    diagonal = np.arange(layout.count)
    rows.append(diagonal)
    columns.append(diagonal)
    values.append(np.where(layout.free, np.maximum(prior, 1e-9), 1.0))
    shape = (layout.count, layout.count)
    normal = coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape
    )
    return normal.tocsc(), np.where(layout.free, gradient, 0.0)


def _moved(state: _State, layout: _Layout, step: NDArray[np.float64]) -> _State:
    camera = step[:CAMERA_PARAMETERS]
    calibration = changed(state.calibration, camera)
    views = {}
    for place, index in enumerate(layout.frames):
        own = step[layout.of_frame(place)]
        view = state.views[index]
        height = calibration.height_metres + view.rocking.height_metres
        views[index] = View(
            view.map_from_robot @ Pose2(float(own[0]), float(own[1]), float(own[2])),
            Rocking(
                view.rocking.pitch_radians + float(own[3]),
                view.rocking.roll_radians + float(own[4]),
                height * math.exp(float(own[5])) - calibration.height_metres,
            ),
        )
    return _State(calibration, views, state.change + camera, state.unevenness_metres)


def _inverse_columns(factor: SuperLU, count: int, wanted: NDArray[np.int64]) -> NDArray[np.float64]:
    unit = np.zeros((count, len(wanted)))
    unit[wanted, np.arange(len(wanted))] = 1.0
    return np.asarray(factor.solve(unit), np.float64)


def _marginals(layout: _Layout, factor: SuperLU, parts: slice) -> list[NDArray[np.float64]]:
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


def _rocking_seen(state: _State, layout: _Layout, factor: SuperLU) -> NDArray[np.float64]:
    """Return the sigmas that the frames' estimated rocking, and its uncertainty, speak for."""
    held = _held(layout, state)
    marginals = _marginals(layout, factor, slice(POSE_PARAMETERS, FRAME_PARAMETERS))
    squares = [
        held[layout.of_frame(place)[POSE_PARAMETERS:]] ** 2 + np.diag(marginal)
        for place, marginal in enumerate(marginals)
    ]
    return np.asarray(np.maximum(np.sqrt(np.mean(squares, axis=0)), _LEAST_ROCKING))


def _camera_covariance(
    layout: _Layout,
    state: _State,
    factor: SuperLU,
    blocks: Sequence[_Block],
    prior: NDArray[np.float64],
    scale: float,
) -> NDArray[np.float64]:
    """Return the camera's covariance, enlarged to what the pairs' disagreement speaks for.

    Errors of one pair are alike (an uneven floor, a blurred picture): each pair's whole gradient
    counts as one error (the sandwich of White, Econometrica 48, 1980, by clusters).
    """
    columns = _inverse_columns(factor, layout.count, np.arange(CAMERA_PARAMETERS))
    told = columns[:CAMERA_PARAMETERS]
    spread = np.zeros((CAMERA_PARAMETERS, CAMERA_PARAMETERS))
    for block in blocks:
        weighted = block.jacobian * _weights(block, scale)[:, None, None]
        gradient = np.einsum("nik,ni->k", weighted, block.residual)
        pull = columns[block.unknowns].T @ np.where(layout.free[block.unknowns], gradient, 0.0)
        spread += np.outer(pull, pull)
    pulls = prior * _held(layout, state)
    for place in range(len(layout.frames)):
        own = layout.of_frame(place)
        pull = columns[own].T @ pulls[own]
        spread += np.outer(pull, pull)
    free = layout.free[:CAMERA_PARAMETERS]
    grown = np.sqrt(np.maximum(np.diag(spread) / np.maximum(np.diag(told), 1e-30), 1.0))
    covariance = told * np.outer(grown, grown)
    return np.asarray(np.where(np.outer(free, free), covariance, 0.0))


def _pose_covariances(layout: _Layout, factor: SuperLU) -> dict[int, NDArray[np.float64]]:
    marginals = _marginals(layout, factor, slice(0, POSE_PARAMETERS))
    covariances = {}
    for place, index in enumerate(layout.frames):
        own = layout.free[layout.of_frame(place)[:POSE_PARAMETERS]]
        covariances[index] = np.where(np.outer(own, own), marginals[place], 0.0)
    return covariances
