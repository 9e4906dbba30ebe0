"""Relocalisation: finds a frame with no pose prior among a map's keyframes.

Place recognition proposes keyframes with the motion that matched points vote for
(`stages.place_index`); each is verified by registration. As no pose can contradict a fit, the
thresholds are strict, and a frame that fits two places of one map is ambiguous: both are rejected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2
from slamcli.core.records import Features, Link, PreparedFrame
from slamcli.mapping import camera_tilt
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.mapping.keyframes import KeyframeDatabase
from slamcli.registration import (
    RegistrationResult,
    count_features,
    direct,
    register,
    register_where_features_agree,
)
from slamcli.registration.hypothesis import max_variance
from slamcli.registration.marks import is_unmistakable
from slamcli.stages import covisibility, dense
from slamcli.stages.place_index import PlaceCandidate

# Multiple of the usual least number of inliers, and least correlation of the overlap's pixels.
# [benchmarks/locate.py: 0 of 500 frames wrong, 0 of 250 outside placed]
_MIN_INLIERS_FACTOR = 3
_MIN_CORRELATION = 0.5
# Least share of the informative patches that agree; less is enough with many inliers, for floor
# that was changed since. [guarded by benchmarks/locate.py]
_MIN_CONFIRMED = 0.9
_MIN_CONFIRMED_BY_MANY = 0.5
# Places of the map that are verified for a frame, and keyframes of each.
# [benchmarks/locate.py: about 30 ms a frame with 100 to 10,000 keyframes]
_MAX_PLACES = 4
_MAX_KEYFRAMES_OF_A_PLACE = 2
# Keyframes with most matches to which a frame is registered by pixels
# [guarded by benchmarks/locate.py].
_MAX_TRACKED = 3
# Two candidates that put the frame nearer than this, as a share of the range and in radians, are of
# one place; more for each keyframe between them, as a map drifts. [guarded by benchmarks/locate.py]
_SAME_SHARE_OF_RANGE = 0.1
_SAME_RADIANS = 0.1
_DRIFT_PER_KEYFRAME = 0.01
# One sigma of the heading that votes put a frame at; of its place, a pixel of the coarsest level
# [benchmarks/locate.py: 2 mm at most].
_VOTED_RADIANS = 0.01
# That is within a pixel of the finest level.
_VOTED_LEVELS = 1
# Sigma of a motion at half the resolution, pixels of it, from which on the full one is used: 0.01
# where the floor has texture [guarded by tests/test_examples.py: 0.07 on the course, 0.3 mm off].
_MAX_ROUGH_PIXELS = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Relocalization:
    """Result of a relocalisation.

    Attributes
    ----------
    registration : RegistrationResult or None
        The accepted one, with a link of kind ``loop``.
    reason : str
        Why there is none; empty when there is.
    """

    registration: RegistrationResult | None
    reason: str

    @property
    def link(self) -> Link | None:
        """From the keyframe to the frame; None when it was not found."""
        return None if self.registration is None else self.registration.link


class Relocalizer:
    """Finds frames among the keyframes of a map, and verifies them.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    database : KeyframeDatabase
    """

    def __init__(
        self, calibration: Calibration, options: MapperOptions, database: KeyframeDatabase
    ) -> None:
        self.database = database
        self._calibration = calibration
        # Floor that is seen again may lie at any angle.
        self._options = replace(options, max_turn_degrees=180.0)
        self._footprint = covisibility.Footprint(calibration)

    def query(
        self, features: Features, excluded: frozenset[int] = frozenset()
    ) -> list[PlaceCandidate]:
        """Return the keyframes that look like a frame, most votes first."""
        return self.database.query(features, excluded)

    def register(
        self,
        a: int,
        prepared: PreparedFrame,
        guess: Pose2,
        prior: dense.MotionPrior | None = None,
    ) -> RegistrationResult:
        """Register a frame to a keyframe near a guess; a link is of kind ``loop``."""
        keyframe = self.database.decode(a)
        return self._checked(
            register(keyframe, prepared, guess, self._calibration, self._options, prior=prior)
        )

    def register_reliably(
        self,
        a: int,
        prepared: PreparedFrame,
        guess: Pose2,
        prior: dense.MotionPrior | None = None,
    ) -> RegistrationResult | None:
        """Register as `register` does; None unless the link is accepted without any pose prior."""
        result = register_where_features_agree(
            self.database.decode(a),
            prepared,
            guess,
            self._calibration,
            self._options,
            _MIN_INLIERS_FACTOR * self._options.matching.min_inliers,
            prior,
        )
        if result is None or not result.correlation >= _MIN_CORRELATION:
            return None
        result = self._checked(result)
        return result if result.link is not None and self._is_unmistakable(result) else None

    def _checked(self, result: RegistrationResult) -> RegistrationResult:
        """Return a result as a loop, without its link where much of the floor does not agree."""
        result = camera_tilt.without_unusual(result, [], self._options)
        if result.link is None:
            return result
        # Boards of one print lie beside boards that differ: most of the floor must be the same.
        # With many inliers on what is left of it, floor may have been changed since.
        share = result.correlation if math.isnan(result.confirmed) else result.confirmed
        many = result.alignment.inlier_count >= self._options.convincing_inliers
        if share < (_MIN_CONFIRMED_BY_MANY if many else _MIN_CONFIRMED):
            reason = (
                f"the floor has changed: {share:.0%} of it looks as in the map; map it again, or "
                f"extend the map (to {result.keyframe.name})"
            )
            return replace(result, link=None, reason=reason)
        return result.as_loop()

    def _is_unmistakable(self, result: RegistrationResult) -> bool:
        keyframe, prepared, fit = result.keyframe, result.prepared, result.fit
        return fit is None or is_unmistakable(keyframe, prepared, fit, self._calibration)

    def track(
        self,
        a: int,
        prepared: PreparedFrame,
        prior: dense.MotionPrior,
        levels: int = direct.LEVELS,
    ) -> RegistrationResult | None:
        """Register a frame to a keyframe by pixels alone, about where it is expected; else None.

        At half the resolution where that of the frame is halved. Where a floor repeats, that is too
        little to tell one period from the next; and where few lines fix the motion, too little to
        measure it.
        """
        halved, expected = prepared.finer is not None, prior.a_from_b
        keyframe = self.database.decode_halved(a) if halved else self.database.decode(a)
        calibration, options = self._calibration, self._options
        # A mask of its own may leave a frame fewer.
        levels = min(levels, len(keyframe.levels), len(prepared.levels))
        result = direct.track(keyframe, prepared, expected, calibration, options, prior, levels)
        if result is None or result.link is None or result.confirmed < _MIN_CONFIRMED:
            return None
        if halved and (_floor_repeats(result) or _is_rough(result)):
            return None
        return result.as_loop()

    def _track_votes(
        self, candidate: PlaceCandidate, prepared: PreparedFrame
    ) -> RegistrationResult | None:
        """Register a frame by pixels alone where votes put it; None unless features agree too.

        As many as `register_reliably` requires, as no pose can contradict the pixels.
        """
        level = prepared.levels[-1]
        sigmas = (level.metres_per_pixel, level.metres_per_pixel, _VOTED_RADIANS)
        prior = dense.MotionPrior(candidate.keyframe_from_now, np.diag(sigmas) ** 2)
        try:
            result = self.track(candidate.keyframe, prepared, prior, _VOTED_LEVELS)
        except FrameError:  # the keyframe's pictures, from a damaged map
            return None
        if result is None or not result.correlation >= _MIN_CORRELATION:
            return None
        least = _MIN_INLIERS_FACTOR * self._options.matching.min_inliers
        count = count_features(result, self._calibration, self._options)
        return result if count >= least else None

    def find_by_pixels(
        self, prepared: PreparedFrame, graph: PoseGraphReader
    ) -> RegistrationResult | None:
        """Register a frame where the keyframes with most matches put it, by pixels alone.

        None unless no other place of the map looks like it at all.
        """
        assert prepared.features is not None
        matches = self.database.match(prepared.features)
        placed = [n for n, k in enumerate(matches.keyframes) if graph.is_placed(k)]
        first = [c for n in placed[:_MAX_TRACKED] if (c := matches.vote(n)) is not None]
        first.sort(key=lambda candidate: -candidate.votes)
        tracked = (self._track_votes(candidate, prepared) for candidate in first)
        result = next(filter(None, tracked), None)
        if result is None or result.link is None:
            return None
        end = result.link.a, result.link.a_from_b
        rest = (
            matches.vote(number)
            for number in placed[_MAX_TRACKED:]
            if not self._see_alike(matches.keyframes[number], end, graph)
        )
        others = [candidate for candidate in rest if candidate is not None]
        for candidate in (*first, *others):
            if not self._same_pose(end, (candidate.keyframe, candidate.keyframe_from_now), graph):
                return None
        return result

    def _see_alike(self, keyframe: int, end: tuple[int, Pose2], graph: PoseGraphReader) -> bool:
        """Return whether a keyframe sees much of what a frame at its pose in another sees."""
        a, a_from_now = end
        if graph[keyframe].fragment != graph[a].fragment:
            return False
        centre = Pose2(*self._footprint.centre.tolist())
        apart = (graph.pose(a) @ a_from_now @ centre).inverse() @ graph.pose(keyframe) @ centre
        return apart.translation_length < self._footprint.radius_metres

    def verify(
        self,
        prepared: PreparedFrame,
        candidates: Sequence[PlaceCandidate],
        graph: PoseGraphReader,
    ) -> Relocalization:
        """Register a frame to the places that candidates propose; accept one place or none."""
        places: list[list[PlaceCandidate]] = []
        for candidate in candidates:
            if not graph.is_placed(candidate.keyframe):
                continue
            same = next((p for p in places if self._same_place(p[0], candidate, graph)), None)
            if same is None:
                places.append([candidate])
            else:
                same.append(candidate)
        accepted: list[RegistrationResult] = []
        for place in places[:_MAX_PLACES]:
            result = self._first_reliable(prepared, place)
            if result is not None and not any(self._same_end(result, a, graph) for a in accepted):
                accepted.append(result)
        if len(accepted) == 1:
            return Relocalization(accepted[0], "")
        if accepted:
            return Relocalization(
                None, f"ambiguous: {len(accepted)} places of the map look like it"
            )
        if not places:
            return Relocalization(None, "not here: no place of the map looks like it")
        return Relocalization(
            None, f"not here: {len(places)} places of the map look like it, but the pixels differ"
        )

    def _first_reliable(
        self, prepared: PreparedFrame, place: Sequence[PlaceCandidate]
    ) -> RegistrationResult | None:
        for candidate in place[:_MAX_KEYFRAMES_OF_A_PLACE]:
            try:
                result = self.register_reliably(
                    candidate.keyframe, prepared, candidate.keyframe_from_now
                )
            except FrameError:  # the keyframe's pictures, from a damaged map
                continue
            if result is not None:
                return result
        return None

    def _same_end(
        self, first: RegistrationResult, second: RegistrationResult, graph: PoseGraphReader
    ) -> bool:
        """Return whether two registrations put the frame at one place."""
        assert first.link is not None
        assert second.link is not None
        return self._same_pose(
            (first.link.a, first.link.a_from_b), (second.link.a, second.link.a_from_b), graph
        )

    def _same_place(
        self, first: PlaceCandidate, second: PlaceCandidate, graph: PoseGraphReader
    ) -> bool:
        """Return whether two candidates put the frame at one place."""
        return self._same_pose(
            (first.keyframe, first.keyframe_from_now),
            (second.keyframe, second.keyframe_from_now),
            graph,
        )

    def _same_pose(
        self, first: tuple[int, Pose2], second: tuple[int, Pose2], graph: PoseGraphReader
    ) -> bool:
        """Return whether two keyframes, with a frame's pose in each, put it at one place."""
        (a, a_from_now), (b, b_from_now) = first, second
        if graph[a].fragment != graph[b].fragment:
            return False
        drift = _DRIFT_PER_KEYFRAME * abs(self.database.steps_between(a, b))
        metres = (_SAME_SHARE_OF_RANGE + drift) * self._calibration.max_range_metres
        return are_near(
            graph.pose(a) @ a_from_now, graph.pose(b) @ b_from_now, metres, _SAME_RADIANS + drift
        )


def _floor_repeats(result: RegistrationResult) -> bool:
    """Return whether floor that two frames both see looks like itself somewhere else in a view."""
    if len(result.keyframe.repeats):
        return True
    return result.overlap < direct.MIN_OVERLAP_OF_PERIODS and len(result.prepared.repeats) > 0


def _is_rough(result: RegistrationResult) -> bool:
    """Return whether a motion is known no better than to some share of a pixel."""
    assert result.link is not None
    limit = _MAX_ROUGH_PIXELS * result.keyframe.levels[0].metres_per_pixel
    return max_variance(result.link.covariance) > limit**2


def are_near(first: Pose2, second: Pose2, metres: float, radians: float) -> bool:
    """Return whether two poses differ by less than a distance and an angle."""
    apart = first.inverse() @ second
    return apart.translation_length < metres and abs(apart.theta) < radians
