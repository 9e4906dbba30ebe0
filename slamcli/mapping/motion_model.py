"""Motion model: predicts the motion to the next frame, and bounds where that frame is searched.

Odometry where it was measured, else constant velocity: the robot is expected to repeat its latest
motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2, wrap_angle
from slamcli.core.records import Link, PreparedFrame
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.tracking_state import TrackingState
from slamcli.stages import dense

# Without a known motion, frames at most this far apart may lie anywhere in each other's view.
# [guarded by benchmarks/robustness.py]
MAX_UNGUIDED_STEPS = 2
# Sigmas of odometry that a search window adds to the free motion of one step.
_SEARCHED_SIGMAS = 3.0
# No window is searched whose radius is a larger multiple of the camera's range: within it pixels
# alone are no proof. [guarded by benchmarks/robustness.py]
_MAX_RADIUS_IN_RANGES = 2.0
# Frames that constant velocity predicts beyond the latest motion: lost ones lie between
# [guarded by benchmarks/tiles.py, benchmarks/kidnap.py].
_MAX_PREDICTED_STEPS = 4
# The spread of constant velocity is learned from this many predictions on, and from the latest few.
# The median of a two-dimensional error's length is 1.18 sigmas; robots also brake and bump, so that
# two medians count as one sigma; none is below this share of the camera's range, and of a radian
# [guarded by benchmarks/tiles.py].
_MIN_PREDICTIONS = 4
MAX_PREDICTIONS = 20
_SIGMAS_OF_MEDIAN = 2.0
_MIN_SIGMA_SHARE = 0.01


class MotionModel:
    """Predictions of the robot's motion from odometry and from its latest motion.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    tracking : TrackingState
        Its motion is updated by `update` alone.
    graph : PoseGraphReader
    sensors : Sensors
    """

    def __init__(
        self,
        calibration: Calibration,
        options: MapperOptions,
        tracking: TrackingState,
        graph: PoseGraphReader,
        sensors: Sensors,
    ) -> None:
        self._range_metres = calibration.max_range_metres
        self._max_radius_metres = _MAX_RADIUS_IN_RANGES * calibration.max_range_metres
        # Free motion in one step, beside what is predicted.
        self._step_metres = options.search_share_of_range * calibration.max_range_metres
        self._angle_radians = math.radians(options.search_angle_degrees)
        self._tracking = tracking
        self._graph = graph
        self._sensors = sensors

    def update(self, index: int) -> None:
        """Take the motion from the frame before to a new one, if both are of one fragment."""
        before, now = self._graph.get(index - 1), self._graph[index]
        latest, self._tracking.motion = self._tracking.motion, None
        if before is not None and before.fragment == now.fragment:
            start = self._graph.pose(before.index)
            motion = start.inverse() @ self._graph.pose(index)
            if latest is not None and self._tracking.motion_frame == before.index:
                self._add_prediction_error(latest.inverse() @ motion)
            self._tracking.motion = motion
            self._tracking.motion_frame = index

    def _add_prediction_error(self, error: Pose2) -> None:
        errors = self._tracking.prediction_errors
        errors.append((error.translation_length, abs(wrap_angle(error.theta))))
        del errors[:-MAX_PREDICTIONS]

    def by_odometry(self, index: int, prepared: PreparedFrame) -> Link | None:
        """Return the motion from a known frame to a new one by odometry; None without readings."""
        return self._sensors.link(self._graph[index], prepared)

    def prior(self, keyframe: PreparedFrame, prepared: PreparedFrame) -> dense.MotionPrior | None:
        """Return ``keyframe_from_prepared`` as expected: by odometry, else by constant velocity.

        None without readings and without a latest motion.
        """
        latest = self._tracking.last_placed
        if keyframe.index in self._tracking.revisited and latest is not None:
            return self._prior_by_map(keyframe, latest, prepared)
        if (link := self.by_odometry(keyframe.index, prepared)) is not None:
            return dense.MotionPrior(link.a_from_b, link.covariance)
        motion, frame = self._tracking.motion, self._tracking.motion_frame
        steps = prepared.index - frame
        if motion is None or not 1 <= steps <= _MAX_PREDICTED_STEPS:
            return None
        start, known = frame, self._graph[keyframe.index]
        if known.map_from_robot is None and keyframe.index > frame:
            # Where a lost frame lies is not known, but how the robot moves on from there.
            start, first = keyframe.index, Pose2()
        elif known.fragment == self._graph[frame].fragment:
            first = self._between(keyframe, frame)
        else:
            return None
        predicted = repeated(first, motion, prepared.index - start)
        # The motion varies by one sigma from each step to the next.
        varied = range(start - frame + 1, steps + 1)
        sigmas = sum(varied) * np.array(self._prediction_sigmas())
        return dense.MotionPrior(predicted, np.diag(sigmas) ** 2)

    def _prior_by_map(
        self, keyframe: PreparedFrame, latest: PreparedFrame, prepared: PreparedFrame
    ) -> dense.MotionPrior | None:
        """Return the motion from a keyframe of long ago: by the map up to the latest frame."""
        step = None if latest is keyframe else self.prior(latest, prepared)
        if (
            step is None
            or self._graph[keyframe.index].fragment != self._graph[latest.index].fragment
        ):
            return None
        keyframe_from_latest = self._between(keyframe, latest.index)
        return dense.MotionPrior(keyframe_from_latest @ step.a_from_b, step.covariance)

    def _prediction_sigmas(self) -> tuple[float, float, float]:
        """Return by how much the motion varies from one frame to the next: x, y (m), theta (rad).

        By the errors of the latest predictions; the free motion of a step before there are some.
        """
        learned = sigmas_of_predictions(self._tracking.prediction_errors, self._range_metres)
        return learned or (self._step_metres, self._step_metres, self._angle_radians)

    def predict_from_link(self, keyframe: PreparedFrame, link: Link) -> Pose2 | None:
        """Return ``keyframe_from_b`` by way of a link from another keyframe of its fragment."""
        if self._graph[link.a].fragment != self._graph[keyframe.index].fragment:
            return None
        return self._between(keyframe, link.a) @ link.a_from_b

    def window(self, keyframe: PreparedFrame, prepared: PreparedFrame) -> dense.SearchWindow | None:
        """Return where a frame may lie for a placed one; None where pixels alone are no proof.

        A periodic floor looks the same one period further on: the window excludes what the robot
        cannot have reached.
        """
        if (window := self._window_from_odometry(keyframe, prepared)) is not None:
            return window
        if self._tracking.motion is None:
            return self._window_everywhere(keyframe, prepared)
        frame = self._tracking.motion_frame
        start, steps = self._between(keyframe, frame), prepared.index - frame
        return self._window_from_motion(self._tracking.motion, start, steps)

    def window_after_lost(
        self, last_lost: PreparedFrame, prepared: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return where a frame may lie for the lost one before it; None as in `window`."""
        if (window := self._window_from_odometry(last_lost, prepared)) is not None:
            return window
        if self._tracking.motion is None:
            return self._window_everywhere(last_lost, prepared)
        steps = prepared.index - last_lost.index
        return self._window_from_motion(self._tracking.motion, Pose2(), steps)

    def window_back(
        self, prepared: PreparedFrame, last_lost: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return where a lost frame may lie for a later, placed one: between it and the one before.

        None as in `window`.
        """
        before = self._graph.get(last_lost.index - 1)
        here = self._graph[prepared.index]
        if before is None or before.fragment != here.fragment or before.map_from_robot is None:
            return self._window_everywhere(last_lost, prepared)
        back = self._graph.pose(prepared.index).inverse() @ before.map_from_robot
        share = (prepared.index - last_lost.index) / (prepared.index - before.index)
        middle = Pose2(share * back.x, share * back.y, share * back.theta)
        radius_metres = self._step_metres + share * back.translation_length
        return dense.SearchWindow(middle, self._angle_radians, radius_metres)

    def _window_from_odometry(
        self, other: PreparedFrame, prepared: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return a window about the motion by odometry; None without readings or when too wide."""
        link = self.by_odometry(other.index, prepared)
        if link is None:
            return None
        sigma_metres = math.sqrt(link.covariance[:2, :2].max())
        radius_metres = self._step_metres + _SEARCHED_SIGMAS * sigma_metres
        if radius_metres > self._max_radius_metres:
            return None
        return dense.SearchWindow(link.a_from_b, self._angle_radians, radius_metres)

    def _window_everywhere(
        self, other: PreparedFrame, prepared: PreparedFrame
    ) -> dense.SearchWindow | None:
        """Return a window without bound for frames that follow each other; None for others."""
        if prepared.index - other.index > MAX_UNGUIDED_STEPS:
            return None
        return dense.SearchWindow(angle_radians=self._angle_radians)

    def _window_from_motion(
        self, motion: Pose2, start: Pose2, steps: int
    ) -> dense.SearchWindow | None:
        """Return a window about `steps` times the latest motion; None when too wide."""
        radius_metres = steps * (self._step_metres + motion.translation_length)
        if steps > MAX_UNGUIDED_STEPS and radius_metres > self._max_radius_metres:
            return None
        predicted = repeated(start, motion, steps)
        return dense.SearchWindow(predicted, self._angle_radians, radius_metres)

    def _between(self, keyframe: PreparedFrame, frame: int) -> Pose2:
        """Return ``keyframe_from_frame`` of a placed frame, by the map."""
        return self._graph.pose(keyframe.index).inverse() @ self._graph.pose(frame)


def repeated(start: Pose2, motion: Pose2, steps: int) -> Pose2:
    """Return the pose after some steps of one motion from a start: constant velocity."""
    pose = start
    for _ in range(steps):
        pose = pose @ motion
    return pose


def sigmas_of_predictions(
    errors: Sequence[tuple[float, float]], range_metres: float
) -> tuple[float, float, float] | None:
    """Return by how much predicted motions are off: x, y (m), theta (rad); None if too few.

    Parameters
    ----------
    errors : sequence of (float, float)
        Of predictions: metres, radians.
    range_metres : float
        How far the camera sees.
    """
    if len(errors) < _MIN_PREDICTIONS:
        return None
    metres, radians = np.median(np.array(errors), axis=0)
    sigma = max(_SIGMAS_OF_MEDIAN * float(metres), _MIN_SIGMA_SHARE * range_metres)
    return sigma, sigma, max(_SIGMAS_OF_MEDIAN * float(radians), _MIN_SIGMA_SHARE)
