"""Uncertainty of a survey's states, and the mount's sigmas that it allows to learn."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse.linalg import splu

from slamcli.core.arrays import Float64Array
from slamcli.survey.bundle import Bundle
from slamcli.survey.lens import Mount
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL, STATES

# The sigmas of tilt and scale are learned within these limits, from the states of at most so many
# frames.
_MIN_SIGMA, _MAX_TILT_SIGMA, _MAX_SCALE_SIGMA, _LEARN_FRAMES = 1e-3, 0.25, 0.5, 40
# The first guess of the tilt's sigma, radians, counts for so many frames.
_GUESS_TILT, _GUESS_FRAMES = 0.02, 3.0


def learned_mount(bundle: Bundle) -> Mount:
    """Return the mount that explains the states best: a step of expectation maximisation."""
    frames = len(bundle.states)
    some = np.unique(np.linspace(0, frames - 1, min(frames, _LEARN_FRAMES)).round().astype(int))
    columns = [LOG_SCALE, PITCH, ROLL]
    variances = np.array([np.diag(c) for c in covariances(bundle, some.tolist(), columns)])
    # About their mean: a tilt that all frames share tilts the map, and is mostly the lens's.
    squares = np.var(bundle.states[:, columns], axis=0) + variances.mean(axis=0)
    known = frames / (frames + _GUESS_FRAMES)
    scale = np.sqrt(squares[0])
    tilt = np.sqrt(known * squares[1:].mean() + (1.0 - known) * _GUESS_TILT**2)
    return Mount(
        float(np.clip(tilt, _MIN_SIGMA, _MAX_TILT_SIGMA)),
        float(np.clip(scale, _MIN_SIGMA, _MAX_SCALE_SIGMA)),
    )


def covariances(
    bundle: Bundle, frames: Sequence[int], columns: Sequence[int]
) -> list[Float64Array]:
    """Return the covariance of some numbers of the states of some frames; 0 of what is fixed."""
    solver = splu(bundle.information)
    place = np.full(STATES * len(bundle.states) + 2, -1)
    place[bundle.free] = np.arange(len(bundle.free))
    found = []
    for frame in frames:
        own = place[STATES * frame + np.array(columns)]
        known = own >= 0
        unit = np.zeros((len(bundle.free), int(known.sum())))
        unit[own[known], np.arange(unit.shape[1])] = 1.0
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(known, known)] = solver.solve(unit)[own[known]]
        found.append(0.5 * (covariance + covariance.T))
    return found
