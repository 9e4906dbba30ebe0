"""Odometry interpolation, its covariance, and the time offset between two clocks."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.geometry import Pose2, compose_poses, relative_poses
from slamcli.core.telemetry import OdometryReading, TelemetryOptions

# Stamps are written with six decimals, so that one moment may differ by this in two files.
SAME_MOMENT_SECONDS = 2e-6
# Fewer motions do not determine an offset [guarded by tests/stages/test_telemetry.py].
_MIN_MOTIONS = 20
# A peak of less correlation is noise; one of a larger sigma is as wide as what was searched
# [guarded by tests/stages/test_telemetry.py].
_MIN_CORRELATION = 0.5
_MAX_SIGMA_STEPS = 2.0
_SMALL_ANGLE_RADIANS = 1e-6
_MIN_ENERGY = 1e-12
# Of the median absolute residual: 6 standard deviations of normal noise
# [guarded by tests/stages/test_telemetry.py].
_OUTLIER_DEVIATIONS = 9.0


class OdometryTrack:
    """Odometry readings in the frames' clock, interpolated to any moment between them.

    Parameters
    ----------
    options : TelemetryOptions
    """

    def __init__(self, options: TelemetryOptions) -> None:
        self._options = options
        self._stamps: list[float] = []
        self._poses: list[Pose2] = []

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, reading: OdometryReading) -> None:
        """Take one reading; of two for one moment the first counts."""
        stamp = reading.stamp + self._options.time_offset_seconds
        index = bisect_left(self._stamps, stamp)
        if index < len(self._stamps) and self._stamps[index] == stamp:
            return
        self._stamps.insert(index, stamp)
        self._poses.insert(index, reading.pose)

    def at(self, stamp: float) -> Pose2 | None:
        """Return ``odom_from_robot`` at a moment; None where odometry does not cover it.

        Between two readings the robot is taken to have moved along an arc at constant speed. On a
        robot a frame comes before the next reading; for as long as the latest two were apart, it
        is taken to have gone on as it did between them. Nothing is assumed beyond that.
        """
        after = bisect_left(self._stamps, stamp - SAME_MOMENT_SECONDS)
        if after < len(self._stamps) and self._stamps[after] <= stamp + SAME_MOMENT_SECONDS:
            return self._poses[after]
        if after == 0 or len(self._stamps) < 2:
            return None
        first = min(after, len(self._stamps) - 1) - 1
        begin, end = self._stamps[first], self._stamps[first + 1]
        apart = end - begin
        if apart > self._options.max_gap_seconds or stamp - end > apart:
            return None
        return interpolate(self._poses[first], self._poses[first + 1], (stamp - begin) / apart)

    def motion(self, begin: float | None, end: float | None) -> Pose2 | None:
        """Return ``begin_from_end``; None where odometry does not cover it, or a moment is None."""
        if begin is None or end is None:
            return None
        first, last = self.at(begin), self.at(end)
        return None if first is None or last is None else first.inverse() @ last


def interpolate(first: Pose2, second: Pose2, share: float) -> Pose2:
    """Return the pose at a share of the arc from one pose (0) to another (1)."""
    row = interpolate_poses(
        (first.x, first.y, first.theta), (second.x, second.y, second.theta), share
    )
    return Pose2(*map(float, row))


def interpolate_poses(first: ArrayLike, second: ArrayLike, share: ArrayLike) -> Float64Array:
    """Return the (..., 3) poses at a share (...) of the arc between (..., 3) poses.

    The arc is the motion of constant speed and turn: ``first exp(share log(first^-1 second))``
    (Sola, Deray and Atchuthan, A micro Lie theory, 2018, eqs. 130 and 156 to 159).
    """
    motion = relative_poses(first, second)
    part = np.asarray(share, dtype=np.float64)
    sine, versine = _arc(motion[..., 2])
    squared = sine**2 + versine**2
    forward = (sine * motion[..., 0] + versine * motion[..., 1]) / squared
    sideways = (sine * motion[..., 1] - versine * motion[..., 0]) / squared
    turn = part * motion[..., 2]
    sine, versine = _arc(turn)
    x = part * (sine * forward - versine * sideways)
    y = part * (versine * forward + sine * sideways)
    return compose_poses(first, np.stack([x, y, turn], axis=-1))


def _arc(turn: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return sin(turn) / turn and (1 - cos(turn)) / turn."""
    small = np.abs(turn) < _SMALL_ANGLE_RADIANS
    safe = np.where(small, 1.0, turn)
    return np.where(small, 1.0, np.sin(safe) / safe), np.where(
        small, turn / 2.0, (1.0 - np.cos(safe)) / safe
    )


def motion_covariance(motion: Pose2, options: TelemetryOptions) -> Float64Array:
    """Return the (3, 3) covariance of a motion by odometry, in its end's own axes."""
    distance, turn = motion.translation_length, abs(motion.theta)
    memory = options.odometry_memory_metres
    along = options.odometry_distance_share**2 * distance * memory + options.odometry_metres**2
    heading = options.odometry_heading_per_metre**2 * distance * memory
    heading += options.odometry_turn_share**2 * turn * math.tau + options.odometry_radians**2
    return np.diag([along, along, heading])


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
        measured = _rates(moments, _sample(stamps, poses, moments - offset))[both]
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


def _sample(stamps: Float64Array, poses: Float64Array, moments: Float64Array) -> Float64Array:
    """Return the (M, 3) poses at (M,) moments; outside the readings, those of the ends."""
    after = np.clip(np.searchsorted(stamps, moments), 1, len(stamps) - 1)
    span = np.maximum(stamps[after] - stamps[after - 1], SAME_MOMENT_SECONDS)
    share = np.clip((moments - stamps[after - 1]) / span, 0.0, 1.0)
    return interpolate_poses(poses[after - 1], poses[after], share)


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
