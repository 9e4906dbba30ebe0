"""Lost frames of a finished map, registered again where the frames around them predict them.

While frames come, a frame is predicted by those before it alone. In the finished map those after it
predict it too, and a motion that was ambiguous may have one explanation left.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.failures import FAILURES, logged
from slamcli.core.geometry import Pose2, wrap_angle
from slamcli.core.records import PoseEstimate, PreparedFrame
from slamcli.mapping import camera_tilt
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.keyframes import KeyframeDatabase
from slamcli.mapping.loop_candidates import max_sigma_metres
from slamcli.mapping.loop_closure import contradicts
from slamcli.mapping.motion_model import MAX_PREDICTIONS, repeated, sigmas_of_predictions
from slamcli.mapping.near_keyframes import NearKeyframes
from slamcli.mapping.tracking import is_mostly_confirmed
from slamcli.registration import RegistrationResult, register
from slamcli.stages import covisibility, dense

# Frames before and after a lost one among which placed ones are looked for: over more the motion
# may be any [guarded by benchmarks/kidnap.py].
_MAX_FRAMES_APART = 8
# Keyframes that a lost frame is registered to.
_MAX_TRIED = 2


@dataclass(frozen=True, slots=True)
class _Neighbours:
    """The nearest placed frames before and after a lost one, of one fragment; None for none."""

    before: int | None
    after: int | None


PrepareAgain = Callable[[Sequence[int]], Iterable[PreparedFrame]]


class LostFrames:
    """Registers lost frames to the keyframes near which the poses around them put them.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    backend : Backend
        Takes the frames that fit.
    database : KeyframeDatabase
    """

    def __init__(
        self,
        calibration: Calibration,
        options: MapperOptions,
        backend: Backend,
        database: KeyframeDatabase,
    ) -> None:
        self._calibration = calibration
        self._options = options
        self._backend = backend
        self._graph, self._sensors = backend.graph, backend.sensors
        self._database = database
        self._footprint = covisibility.Footprint(calibration)
        # What predicted a frame when it was last registered: the same again gives the same.
        self._tried: dict[int, _Neighbours] = {}

    def place(self, prepare_again: PrepareAgain, tilts_radians: list[float]) -> bool:
        """Register lost frames once more; return whether some are placed now.

        Parameters
        ----------
        prepare_again : function
            Of indices to these frames, prepared.
        tilts_radians : list of float
            Of the links so far.
        """
        placed = False
        for prepared in prepare_again(self._predicted()):
            known = self._graph[prepared.index]
            try:
                result = self._register(prepared, tilts_radians)
            except FAILURES as error:
                logged(error)
                continue
            if result is not None and result.link is not None:
                self._backend.place_between(prepared, result.link)
                placed = True
            elif result is not None:
                self._graph.set_estimate(replace(known, reason=result.reason))
        return placed

    def _predicted(self) -> list[int]:
        """Return the lost frames that others predict and that were not registered by these yet."""
        return [
            estimate.index
            for estimate in self._graph.estimates
            if estimate.status == "lost"
            and self._tried.get(estimate.index) != self._neighbours(estimate.index)
            and self._prior(estimate) is not None
        ]

    def _register(
        self, prepared: PreparedFrame, tilts_radians: list[float]
    ) -> RegistrationResult | None:
        """Return the result for a lost frame; None when it shows nothing or none predicts it."""
        estimate = self._graph[prepared.index]
        prior = self._prior(estimate)
        self._tried[prepared.index] = self._neighbours(prepared.index)
        if prior is None or not prepared.levels:
            return None
        fragment, map_prior = prior
        result = None
        members = [i for i in self._database.order if self._is_tracked(i, fragment)]
        keyframes = NearKeyframes(self._footprint, members, self._graph)
        near = keyframes.find(map_prior.a_from_b, _MAX_TRIED, self._options.min_overlap)
        for index, expected in near:
            try:
                keyframe = self._database.decode(index)
            except FrameError:  # the keyframe's pictures, from a damaged map
                continue
            prior_here = dense.MotionPrior(expected, map_prior.covariance)
            result = self._checked(
                register(
                    keyframe, prepared, expected, self._calibration, self._options, prior=prior_here
                ),
                prior_here,
                tilts_radians,
            )
            if result.link is not None:
                break
        return result

    def _checked(
        self, result: RegistrationResult, prior: dense.MotionPrior, tilts_radians: list[float]
    ) -> RegistrationResult:
        """Leave out a link that the prediction or most of the floor contradicts."""
        result = camera_tilt.without_unusual(result, tilts_radians, self._options)
        if result.link is None:
            return result
        link = result.link
        if is_mostly_confirmed(result) and not contradicts(prior, link.a_from_b, link.covariance):
            return result
        reason = f"the frames before and after contradict the fit (to {result.keyframe.name})"
        return replace(result, link=None, reason=reason)

    def _neighbours(self, index: int) -> _Neighbours:
        """Return the nearest placed frames; the later one alone where their fragments differ."""
        graph = self._graph

        def first(indices: range) -> int | None:
            placed = (i for i in indices if (known := graph.get(i)) and known.status == "tracked")
            return next(placed, None)

        before = first(range(index - 1, index - 1 - _MAX_FRAMES_APART, -1))
        after = first(range(index + 1, index + 1 + _MAX_FRAMES_APART))
        if before is None or after is None or graph[before].fragment == graph[after].fragment:
            return _Neighbours(before, after)
        # The motion of either predicts the frame; the nearer is more certain.
        if index - before <= after - index:
            return _Neighbours(before, None)
        return _Neighbours(None, after)

    def _prior(self, estimate: PoseEstimate) -> tuple[int, dense.MotionPrior] | None:
        """Return a frame's fragment and its predicted pose in it; None where it is uncertain."""
        near = self._neighbours(estimate.index)
        predicted = self._by_odometry(estimate, near) or self._by_motion(estimate.index, near)
        if predicted is None:
            return None
        fragment, prior = predicted
        sigma = math.sqrt(float(prior.covariance[:2, :2].max()))
        return None if sigma > max_sigma_metres(self._calibration) else (fragment, prior)

    def _by_odometry(
        self, estimate: PoseEstimate, near: _Neighbours
    ) -> tuple[int, dense.MotionPrior] | None:
        for index in (near.before, near.after):
            if index is None:
                continue
            link = self._sensors.link(self._graph[index], estimate)
            if link is not None:
                pose = self._graph.pose(index) @ link.a_from_b
                return self._graph[index].fragment, dense.MotionPrior(pose, link.covariance)
        return None

    def _by_motion(self, index: int, near: _Neighbours) -> tuple[int, dense.MotionPrior] | None:
        """Return the pose on the way between two frames, or by constant velocity from one side.

        A change of velocity from step to step that is one sigma of the usual puts a frame k steps
        from one of two neighbours, n apart, off by ``k (n - k) / 2`` sigmas; one that is m steps
        beyond the last, by ``m (m + 1) / 2``.
        """
        graph = self._graph
        anchor = near.before if near.after is None else near.after
        if anchor is None:
            return None
        fragment = graph[anchor].fragment
        sigmas = self._sigmas_of_a_step(anchor, fragment)
        if sigmas is None:
            return None
        if near.before is not None and near.after is not None:
            steps, gone = near.after - near.before, index - near.before
            motion = graph.pose(near.before).inverse() @ graph.pose(near.after)
            pose = graph.pose(near.before) @ _share_of(motion, gone / steps)
            spread = max(0.5 * gone * (steps - gone), 1.0)
        else:
            beyond = index - anchor
            other = anchor - 1 if beyond > 0 else anchor + 1
            if not self._is_tracked(other, fragment):
                return None
            motion = graph.pose(other).inverse() @ graph.pose(anchor)
            pose = repeated(graph.pose(anchor), motion, abs(beyond))
            spread = 0.5 * abs(beyond) * (abs(beyond) + 1)
        return fragment, dense.MotionPrior(pose, np.diag(spread * np.array(sigmas)) ** 2)

    def _sigmas_of_a_step(self, about: int, fragment: int) -> tuple[float, float, float] | None:
        """Return how much the motion varies from step to step near a frame; None if unknown."""
        errors = []
        for middle in range(about - MAX_PREDICTIONS, about + MAX_PREDICTIONS + 1):
            if all(self._is_tracked(index, fragment) for index in range(middle - 1, middle + 2)):
                first, second, third = (
                    self._graph.pose(index) for index in range(middle - 1, middle + 2)
                )
                change = (first.inverse() @ second).inverse() @ (second.inverse() @ third)
                errors.append((change.translation_length, abs(wrap_angle(change.theta))))
        return sigmas_of_predictions(errors, self._calibration.max_range_metres)

    def _is_tracked(self, index: int, fragment: int) -> bool:
        known = self._graph.get(index)
        return known is not None and known.status == "tracked" and known.fragment == fragment


def _share_of(motion: Pose2, share: float) -> Pose2:
    """Return a share of a motion at constant velocity, along its arc."""
    if motion.theta == 0.0:
        return Pose2(share * motion.x, share * motion.y)
    turn, part = (cmath.exp(1j * angle) - 1.0 for angle in (motion.theta, share * motion.theta))
    place = complex(motion.x, motion.y) * part / turn
    return Pose2(place.real, place.imag, share * motion.theta)
