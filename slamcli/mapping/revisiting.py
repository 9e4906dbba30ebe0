"""Revisited floor: frames are tracked by the keyframes that show it already, in place of new ones.

Where a robot drives over the same floor again, every new keyframe would show what others show. Once
a loop connects the newest keyframe with earlier ones, frames go over to these: the first one with a
link to both, which closes the loop anew. A map grows with its floor so, not with the time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2, pose_array, relative_poses
from slamcli.core.records import PreparedFrame
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.mapping.loop_closure import LoopCloser
from slamcli.mapping.motion_model import MotionModel, repeated
from slamcli.mapping.tracking import Tracker
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult
from slamcli.stages import covisibility, dense

# Frames ahead for which a keyframe is chosen: it is to serve as many as possible.
_FRAMES_AHEAD = 8
# A loop that decides where all frames after it lie must be as good as certain [benchmarks/score.py:
# one in a thousand is wrong].
_MIN_SCORE = 0.99
# By how much more the footprints must overlap than views do [stages/covisibility.py: 0.06].
_MARGIN_OF_FOOTPRINTS = 0.05


class Revisiting:
    """Tracking by keyframes of floor that is seen again.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    tracking : TrackingState
        Read, not changed.
    motion_model : MotionModel
    tracker : Tracker
    loop_closer : LoopCloser
    graph : PoseGraphReader
    """

    def __init__(
        self,
        calibration: Calibration,
        options: MapperOptions,
        tracking: TrackingState,
        motion_model: MotionModel,
        tracker: Tracker,
        loop_closer: LoopCloser,
        graph: PoseGraphReader,
    ) -> None:
        self._min_overlap = options.keyframe_overlap + _MARGIN_OF_FOOTPRINTS
        self._tracking = tracking
        self._motion_model = motion_model
        self._tracker = tracker
        self._loop_closer = loop_closer
        self._graph = graph
        self._footprint = covisibility.Footprint(calibration)

    def track(self, prepared: PreparedFrame) -> list[RegistrationResult]:
        """Return a frame's link to the newest keyframe and its loop to one that shows its floor.

        None where no earlier keyframe shows enough of it, or where either is not certain: the frame
        may become a keyframe then.
        """
        if not self._tracker.is_steady(prepared):
            return []
        newest = self._tracking.keyframes[-1]
        prior = self._motion_model.prior(newest, prepared)
        if prior is None:
            return []
        known = self._known_keyframe(newest, prior.a_from_b)
        if known is None:
            return []
        step = self._tracker.track_closely(newest, prepared, prior)
        if step is None or step.link is None:
            return []
        guess = self._motion_model.predict_from_link(known, step.link)
        if guess is None:
            return []
        expected = dense.MotionPrior(guess, prior.covariance)
        loop = self._tracker.track_known(known, prepared, expected)
        if loop is None or loop.link is None or loop.link.score < _MIN_SCORE:
            return []
        return [step, loop.as_loop()]

    def _known_keyframe(
        self, newest: PreparedFrame, newest_from_now: Pose2
    ) -> PreparedFrame | None:
        """Return the stored keyframe that shows the floor of most frames from this one on."""
        motion = self._tracking.motion
        if motion is None or not self._graph.is_placed(newest.index):
            return None
        candidates = self._loop_closer.connected(newest.index, self._graph)
        if not candidates:
            return None
        here = self._graph.pose(newest.index) @ newest_from_now
        ahead = [repeated(here, motion, steps) for steps in range(_FRAMES_AHEAD)]
        served = self._frames_served(candidates, ahead)
        best = int(np.argmax(served))
        if not served[best]:
            return None
        try:
            return self._loop_closer.decode(candidates[best])
        except FrameError:  # its pictures, from a damaged map
            return None

    def _frames_served(self, candidates: Sequence[int], ahead: Sequence[Pose2]) -> Float64Array:
        """Return (K,): how many of the frames to come each keyframe shows enough of.

        Those of a tie differ by how much they show.
        """
        keyframes = pose_array([self._graph.pose(index) for index in candidates])
        motions = relative_poses(keyframes[:, None], pose_array(ahead)[None])
        flat = self._footprint.overlaps(motions.reshape(-1, 3))
        shares = flat.reshape(motions.shape[:2])
        # A keyframe serves the frames up to the first of which it shows too little.
        served = np.logical_and.accumulate(shares >= self._min_overlap, axis=1)
        return np.asarray((served * (1.0 + shares)).sum(axis=1))
