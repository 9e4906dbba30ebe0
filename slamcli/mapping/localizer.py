"""Localisation in a finished map: of single frames, and of a robot that is followed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.config import MapperOptions
from slamcli.core.failures import FAILURES, logged
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import FloorMap, Frame, PoseEstimate, PreparedFrame
from slamcli.mapping.backend.pose_graph import PoseGraph, lost
from slamcli.mapping.frame_checks import fault_of_expectation
from slamcli.mapping.keyframes import KeyframeDatabase
from slamcli.mapping.locks import ReentrantLock
from slamcli.mapping.near_keyframes import NearKeyframes
from slamcli.mapping.query_frames import QueryPreprocessor
from slamcli.mapping.relocalization import Relocalization, Relocalizer
from slamcli.registration import RegistrationResult
from slamcli.registration.rivals import is_expected
from slamcli.stages import covisibility, dense

# Metres and radians: what a robot's own motion model leaves open after a step or two.
_SIGMA = (0.05, 0.05)
# Keyframes about an expected pose that are tried, and the share of the frame's floor that they see
# [guarded by tests/mapping/test_localizer.py].
_MAX_KEYFRAMES = 2
_MIN_OVERLAP = 0.4
# After this many lost frames the robot may be anywhere.
_MAX_FRAMES_LOST = 10

# A keyframe, and the motion from it to the frame as expected.
_Expected = tuple[int, dense.MotionPrior]


class Locator:
    """Finds frames in a map, each by itself: nothing is known of where the robot was before.

    `locate` never raises, whatever the frame, and threads may share a locator.

    Parameters
    ----------
    floor_map : FloorMap
        From `slamcli.load_map`.
    """

    def __init__(self, floor_map: FloorMap) -> None:
        self.calibration = floor_map.calibration
        options = replace(
            MapperOptions(),
            features=floor_map.features,
            metres_per_pixel=floor_map.metres_per_pixel,
            tilt_sigma_degrees=floor_map.tilt_sigma_degrees,
        )
        self._preprocessor = QueryPreprocessor(floor_map.calibration, options)
        database = KeyframeDatabase(self.grid, options.matching.seed)
        self._relocalizer = Relocalizer(floor_map.calibration, options, database)
        self._graph = PoseGraph()
        for keyframe in floor_map.keyframes:
            database.add(keyframe)
        for estimate in floor_map.estimates:
            self._graph.set_estimate(estimate)
        self._options = options
        placed = [index for index in database.order if self._graph.is_placed(index)]
        footprint = covisibility.Footprint(floor_map.calibration)
        self._near = NearKeyframes(footprint, placed, self._graph)
        self._count, self._lock = 0, ReentrantLock()

    @property
    def grid(self) -> Grid:
        """Of the views that are compared by their pixels, in the robot frame."""
        return self._preprocessor.full.grid

    def locate(
        self,
        frame: Frame | UInt8Array,
        near: Pose2 | None = None,
        sigma: tuple[float, float] = _SIGMA,
    ) -> PoseEstimate:
        """Return where a frame is on the map; lost, with the reason, when it is not there.

        Parameters
        ----------
        frame : Frame, or (H, W[, 3]) uint8 BGR or gray pixels
        near : Pose2 or None
            ``map_from_robot`` as expected: the keyframes there are tried first, which takes a
            fraction of the time; then the whole map.
        sigma : (float, float)
            Of that expectation, metres and radians. A frame that is found elsewhere all the same is
            given where it is found.

        Returns
        -------
        PoseEstimate
            Its covariance is that of the map's keyframe and of the link to it; its score
            how likely that link is right.
        """
        if not isinstance(frame, Frame):
            with self._lock:
                frame = Frame(self._count, f"frame {self._count}", None, frame)
                self._count += 1
        return self.place(self.prepare(frame), near, sigma)

    def prepare(self, frame: Frame) -> PreparedFrame:
        """Compute all that needs no map; may run ahead on any thread. Never raises."""
        return self._preprocessor.prepare(frame)

    def place(
        self,
        prepared: PreparedFrame,
        near: Pose2 | None = None,
        sigma: tuple[float, float] = _SIGMA,
    ) -> PoseEstimate:
        """Return where a prepared frame is on the map, as `locate`."""
        if prepared.extraction is None:
            return lost(prepared, prepared.reason)
        if near is not None and (fault := fault_of_expectation(near, sigma)):
            return lost(prepared, fault)
        try:
            found = self._find(prepared, [] if near is None else self._nearest(near, sigma))
            if found.link is None:
                return lost(prepared, found.reason)
            return self._graph.predict_pose(prepared, [found.link])
        except FAILURES as error:
            return lost(prepared, f"cannot be located: {logged(error)}")

    def _nearest(self, near: Pose2, sigma: tuple[float, float]) -> list[_Expected]:
        """Return the keyframes near an expected pose, each with the motion from it as expected."""
        metres, radians = sigma
        covariance = np.diag([metres, metres, radians]) ** 2
        return [
            (index, dense.MotionPrior(expected, covariance))
            for index, expected in self._near.find(near, _MAX_KEYFRAMES, _MIN_OVERLAP)
        ]

    def _find(self, prepared: PreparedFrame, nearest: Sequence[_Expected]) -> Relocalization:
        """Register a frame at half the resolution, or else at the full one.

        Both to the nearest keyframes first, and then where it looks like the map.
        """
        result = self._track_near(prepared, nearest)
        if result is None and prepared.finer is not None:
            result = self._relocalizer.find_by_pixels(prepared, self._graph)
            if result is None:
                return self._find(prepared.finer.value, nearest)
        if result is None and prepared.levels:
            result = self._register_near(prepared, nearest)
        if result is not None:
            return Relocalization(result, "")
        if prepared.features is None:
            return Relocalization(None, prepared.reason)
        candidates = self._relocalizer.query(prepared.features)
        return self._relocalizer.verify(prepared, candidates, self._graph)

    def _register_near(
        self, prepared: PreparedFrame, nearest: Sequence[_Expected]
    ) -> RegistrationResult | None:
        """Register a frame by its features to the nearest keyframe, where that is as expected."""
        for index, prior in nearest[:1]:
            found = self._relocalizer.register_reliably(index, prepared, prior.a_from_b, prior)
            if found is not None and found.link is not None:
                return found if is_expected(prior, found.link.a_from_b) else None
        return None

    def _track_near(
        self, prepared: PreparedFrame, nearest: Sequence[_Expected]
    ) -> RegistrationResult | None:
        """Register a frame to the first of some keyframes from which pixels prove its motion."""
        levels = len(prepared.levels)
        for index, prior in nearest if levels else ():
            # It may be off by more pixels of the fine levels than a refinement on them alone makes
            # good: on all levels 38 of 40 frames are tracked, in place of 21
            # [benchmarks/locate.py: 1 cm and 1 degree off].
            result = self._relocalizer.track(index, prepared, prior, levels)
            if result is not None:
                return result
        return None


class Follower:
    """Follows a robot in a finished map: each frame is located near where it is expected.

    By the latest motion, or by the robot's own odometry; a frame that is not found there is looked
    for on the whole map. `update` never raises.

    Parameters
    ----------
    locator : Locator
    """

    def __init__(self, locator: Locator) -> None:
        self._locator = locator
        self._pose: Pose2 | None = None
        self._motion = Pose2()
        self._since = 0

    def update(self, frame: Frame | UInt8Array, motion: Pose2 | None = None) -> PoseEstimate:
        """Return where the next frame is on the map; lost, with the reason, when it is not there.

        Parameters
        ----------
        frame : Frame, or (H, W[, 3]) uint8 BGR or gray pixels
        motion : Pose2 or None
            ``before_from_now`` by odometry; None repeats the latest motion.
        """
        near, sigma = self._expected(motion)
        return self._follow(self._locator.locate(frame, near, sigma))

    def place(self, prepared: PreparedFrame) -> PoseEstimate:
        """Return where a frame that `Locator.prepare` prepared is, as `update`."""
        near, sigma = self._expected(None)
        return self._follow(self._locator.place(prepared, near, sigma))

    def _expected(self, motion: Pose2 | None) -> tuple[Pose2 | None, tuple[float, float]]:
        """Return the next frame's pose as expected, with its sigmas; None where it is not known."""
        if motion is not None:
            if fault_of_expectation(motion):
                # Refused by the locator.
                return motion, _SIGMA
            self._motion = motion
        if self._pose is None or self._since >= _MAX_FRAMES_LOST:
            return None, _SIGMA
        self._pose = self._pose @ self._motion
        self._since += 1
        metres, radians = _SIGMA
        metres = max(metres, self._motion.translation_length)
        sigma = (
            self._since * metres,
            self._since * max(radians, abs(self._motion.theta)),
        )
        if fault_of_expectation(self._pose, sigma):
            # Each motion was within its bounds, and all of them together are not.
            return None, _SIGMA
        return self._pose, sigma

    def _follow(self, estimate: PoseEstimate) -> PoseEstimate:
        found = estimate.map_from_robot
        if found is not None:
            if self._pose is not None and self._since == 1:
                before = self._pose @ self._motion.inverse()
                self._motion = before.inverse() @ found
            else:
                self._motion = Pose2()
            self._pose, self._since = found, 0
        return estimate
