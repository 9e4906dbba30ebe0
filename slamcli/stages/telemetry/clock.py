"""The time offset between two clocks, by motions that both saw."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.geometry import relative_poses
from slamcli.stages.telemetry.odometry import SAME_MOMENT_SECONDS, sample

# Fewer motions do not determine an offset [guarded by tests/stages/test_telemetry.py].
_MIN_MOTIONS = 20
# A peak of less correlation is noise; one of a larger sigma is as wide as what was searched
# [guarded by tests/stages/test_telemetry.py].
_MIN_CORRELATION = 0.5
_MAX_SIGMA_STEPS = 2.0
_MIN_ENERGY = 1e-12
# Of the median absolute residual: 6 standard deviations of normal noise
# [guarded by tests/stages/test_telemetry.py].
_OUTLIER_DEVIATIONS = 9.0


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """The offset between the telemetry's clock and the frames'.

    Attributes
    ----------
    seconds : float
        To be added to the telemetry's stamps.
    sigma_seconds : float
    correlation : float
        Of the better of both signals, speed and turn, at that offset.
    """

    seconds: float
    sigma_seconds: float
    correlation: float


def estimate_time_offset(
    odometry: tuple[ArrayLike, ArrayLike],
    visual: tuple[ArrayLike, ArrayLike],
    *,
    largest_seconds: float = 2.0,
    step_seconds: float = 0.02,
) -> TimeOffset | None:
    """Return the offset at which odometry's speed and turn go with what the frames saw.

    The most likely one, for an unknown gain, bias and noise of either signal: the largest
    ``-N/2 log(1 - correlation^2)``, summed over both. Found on a grid of offsets, then by a
    parabola.

    Parameters
    ----------
    odometry : (N,) stamps and (N, 3) poses
    visual : (M,) stamps and (M, 3) poses
        Of consecutive placed frames of one fragment.
    largest_seconds : float
        Offsets up to this are tried, either way.
    step_seconds : float

    Returns
    -------
    TimeOffset, or None when the motion is too even, or too short, to determine it.
    """
    stamps, poses = (np.asarray(array, dtype=np.float64) for array in odometry)
    moments, seen = (np.asarray(array, dtype=np.float64) for array in visual)
    if len(stamps) < 2 or len(moments) <= _MIN_MOTIONS:
        return None
    rates = _rates(moments, seen)

    def likelihood(offset: float) -> tuple[float, float]:
        inside = (moments - offset >= stamps[0]) & (moments - offset <= stamps[-1])
        both = inside[:-1] & inside[1:]
        if both.sum() < _MIN_MOTIONS:
            return -math.inf, 0.0
        measured = _rates(moments, sample(stamps, poses, moments - offset))[both]
        return _likelihood(measured, rates[both])

    grid = np.arange(-largest_seconds, largest_seconds + step_seconds / 2, step_seconds)
    return _peak(likelihood, grid)


def _peak(
    likelihood: Callable[[float], tuple[float, float]], grid: Float64Array
) -> TimeOffset | None:
    """Return the inner maximum over the grid, refined; None when it is flat or at an end."""
    values = np.array([likelihood(float(offset))[0] for offset in grid])
    best = int(np.argmax(values))
    if best in {0, len(grid) - 1} or not np.isfinite(values[best - 1 : best + 2]).all():
        return None
    before, top, after = values[best - 1 : best + 2]
    step = grid[1] - grid[0]
    bend = (2.0 * top - before - after) / step**2
    if bend <= 0.0:
        return None
    offset = float(grid[best] + (after - before) / (2.0 * bend * step))
    sigma = 1.0 / math.sqrt(bend)
    correlation = likelihood(offset)[1]
    if correlation < _MIN_CORRELATION or sigma > _MAX_SIGMA_STEPS * step:
        return None
    return TimeOffset(offset, sigma, correlation)


def _rates(moments: Float64Array, poses: Float64Array) -> Float64Array:
    """Return (M - 1, 2): speed along the robot's axis (m/s) and turn (rad/s)."""
    motions = relative_poses(poses[:-1], poses[1:])
    spans = np.maximum(np.diff(moments), SAME_MOMENT_SECONDS)
    return motions[:, [0, 2]] / spans[:, None]


def _likelihood(odometry: Float64Array, visual: Float64Array) -> tuple[float, float]:
    """Return the log-likelihood up to a constant, and the better correlation."""
    total, best = 0.0, 0.0
    for x, y in zip(odometry.T, visual.T, strict=True):
        kept = _fitting(x, y)
        a, b = x[kept] - x[kept].mean(), y[kept] - y[kept].mean()
        energy = math.sqrt(float(a @ a) * float(b @ b))
        if energy < _MIN_ENERGY:
            continue
        correlation = min(max(float(a @ b) / energy, 0.0), 1.0 - 1e-9)
        total -= 0.5 * len(x) * math.log(1.0 - correlation**2)
        best = max(best, correlation)
    return total, best


def _fitting(x: Float64Array, y: Float64Array) -> BoolArray:
    """Return which pairs lie near a line: one slip of a wheel would outweigh all the rest."""
    away = np.abs(x - np.median(x))
    kept: BoolArray = away <= float(np.percentile(away, 98.0))
    spread = float(np.var(x[kept]))
    if spread < _MIN_ENERGY:
        return kept
    gain = float(np.mean((x[kept] - x[kept].mean()) * (y[kept] - y[kept].mean()))) / spread
    residuals = y - gain * x
    residuals = np.abs(residuals - np.median(residuals))
    fitting: BoolArray = residuals <= _OUTLIER_DEVIATIONS * float(np.median(residuals))
    return fitting
