"""Odometry: interpolation between readings, and the covariance of a motion."""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np
from numpy.typing import ArrayLike

from slamcli.core.arrays import Float64Array, Int64Array
from slamcli.core.geometry import Pose2, compose_poses, pose_array, relative_poses
from slamcli.core.telemetry import OdometryReading, TelemetryOptions

# Stamps are written with six decimals, so that one moment may differ by this in two files.
SAME_MOMENT_SECONDS = 2e-6
_SMALL_ANGLE_RADIANS = 1e-6
# Odometry that leaps by so many times its longest step, after so many steps, was reset: fewer times
# where it comes back to its origin, within this share of its distance from there
# [guarded by tests/stages/test_agreement.py].
_LEAP, _MIN_STEPS, _MAX_BACK_SHARE = 5.0, 3, 0.2
_LONG_LEAP, _MIN_STEPS_OF_LONG_LEAP = 20.0, 10
# Shorter steps are the noise of standing wheels.
_MIN_STEP_METRES = 0.001


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
        # Number of the reset before each reading, and what is known of the steps since.
        self._pieces: list[int] = []
        self._steps = _Steps()

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, reading: OdometryReading) -> None:
        """Take one reading; of two for one moment the first counts."""
        stamp = reading.stamp + self._options.time_offset_seconds
        index = bisect_left(self._stamps, stamp)
        if index < len(self._stamps) and self._stamps[index] == stamp:
            return
        late = index < len(self._stamps)
        self._stamps.insert(index, stamp)
        self._poses.insert(index, reading.pose)
        if late:
            self._steps, self._pieces = _Steps(), []
        for place in range(len(self._pieces), len(self._stamps)):
            is_reset = self._steps.add(self._stamps[place], self._poses[place])
            self._pieces.append((self._pieces[-1] if place else 0) + is_reset)

    @property
    def resets(self) -> list[float]:
        """The moments of readings that begin anew, where the one before was far away."""
        pieces = self._pieces
        return [self._stamps[k] for k in range(1, len(pieces)) if pieces[k] != pieces[k - 1]]

    def arrays(self) -> tuple[Float64Array, Float64Array, Int64Array]:
        """Return (N,) stamps in the frames' clock, (N, 3) poses, and (N,) resets before each."""
        pieces = np.array(self._pieces, np.int64)
        return np.array(self._stamps, np.float64), pose_array(self._poses), pieces

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
        if self._pieces[first] != self._pieces[first + 1] and stamp <= end:
            return None
        if apart > self._options.max_gap_seconds or stamp - end > apart:
            return None
        return interpolate(self._poses[first], self._poses[first + 1], (stamp - begin) / apart)

    def motion(self, begin: float | None, end: float | None) -> Pose2 | None:
        """Return ``begin_from_end``; None where odometry does not cover it, or a moment is None."""
        if begin is None or end is None:
            return None
        first, last = self.at(begin), self.at(end)
        if first is None or last is None or self._piece(begin) != self._piece(end):
            return None
        return first.inverse() @ last

    def _piece(self, stamp: float) -> int:
        """Return the number of resets before a moment."""
        after = bisect_left(self._stamps, stamp - SAME_MOMENT_SECONDS)
        return self._pieces[min(after, len(self._pieces) - 1)]


class _Steps:
    """The steps from reading to reading since the latest reset."""

    def __init__(self) -> None:
        self._empty = True
        self._latest = Pose2()
        self._stamp = 0.0
        self._begin(Pose2())

    def _begin(self, pose: Pose2) -> None:
        self._origin = pose
        self._longest_metres = self._fastest = 0.0
        self._moving = 0

    def add(self, stamp: float, pose: Pose2) -> bool:
        """Take a reading; return whether the odometry was reset before it.

        It then comes back to where it began in one leap, or leaps farther still to anywhere.
        """
        step = self._latest.inverse() @ pose
        metres, seconds = step.translation_length, stamp - self._stamp
        usual = max(self._longest_metres, self._fastest * seconds)
        before = (self._origin.inverse() @ self._latest).translation_length
        back = (self._origin.inverse() @ pose).translation_length < _MAX_BACK_SHARE * before
        leaps = back and metres > _LEAP * usual and self._moving >= _MIN_STEPS
        leaps |= metres > _LONG_LEAP * usual and self._moving >= _MIN_STEPS_OF_LONG_LEAP
        if leaps or self._empty:
            self._begin(pose)
        elif metres > _MIN_STEP_METRES:
            self._moving += 1
            self._longest_metres = max(self._longest_metres, metres)
            self._fastest = max(self._fastest, metres / max(seconds, SAME_MOMENT_SECONDS))
        self._latest, self._stamp, self._empty = pose, stamp, False
        return leaps


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


def sample(stamps: Float64Array, poses: Float64Array, moments: Float64Array) -> Float64Array:
    """Return the (M, 3) poses at (M,) moments; outside the readings, those of the ends."""
    after = np.clip(np.searchsorted(stamps, moments), 1, len(stamps) - 1)
    span = np.maximum(stamps[after] - stamps[after - 1], SAME_MOMENT_SECONDS)
    share = np.clip((moments - stamps[after - 1]) / span, 0.0, 1.0)
    return interpolate_poses(poses[after - 1], poses[after], share)


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
