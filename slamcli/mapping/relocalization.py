"""A frame of which nothing is known against the keyframes of a map: where it is, or why not.

A frame's points recall places (`stages.places`); the motion that they vote for is compared like any
other. With no pose to contradict a fit, much is asked of it, and a frame that recalls two spots of
one map with equal right is ambiguous: neither is believed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Features, Keyframe, PreparedFrame
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.keyframes import KeyframeCache
from slamcli.registration import RegistrationResult, register
from slamcli.stages.place_index import PlaceCandidate, PlaceIndex

# A motion needs so many times the usual inliers, and pixels that agree well.
_MIN_INLIERS = 3
# Of the patches of floor that tell, for a place to be the same.
_MIN_CONFIRMED = 0.9
_MIN_CONFIRMED_BY_MANY = 0.5
_MIN_CORRELATION = 0.5
# So many spots of the map are compared with a frame that recalls them, from so many keyframes each.
_MAX_SPOTS = 4
_PLACES_OF_A_SPOT = 2
# Two recalled places nearer than this, as a share of the range and in radians, are one spot; so
# much more for each keyframe between them, as a map drifts.
_SAME_SHARE_OF_RANGE = 0.1
_SAME_RADIANS = 0.1
_DRIFT_A_KEYFRAME = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Relocalization:
    """What came of it.

    Attributes
    ----------
    trial : RegistrationResult or None
        The believed one, with a link of kind ``loop``.
    reason : str
        Why there is none; empty when there is.
    """

    trial: RegistrationResult | None
    reason: str


class Relocalizer:
    """Keyframes that stay, to be found by what they look like.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    grid : Grid
        Of the views.
    """

    def __init__(self, calibration: Calibration, options: MapperOptions, grid: Grid) -> None:
        self._calibration = calibration
        # Floor that is seen again may lie at any angle.
        self._options = replace(options, max_turn_degrees=180.0)
        self._expander = KeyframeCache(grid)
        self._index = PlaceIndex(options.matching.seed)
        self._keyframes: dict[int, Keyframe] = {}
        self.order: list[int] = []
        self._number: dict[int, int] = {}

    def __contains__(self, index: int) -> bool:
        return index in self._number

    @property
    def keyframes(self) -> list[Keyframe]:
        """All that are kept, in the order of their making."""
        return [self._keyframes[index] for index in self.order]

    def add(self, keyframe: Keyframe) -> None:
        """Keep one more keyframe."""
        self._number[keyframe.index] = len(self.order)
        self.order.append(keyframe.index)
        self._keyframes[keyframe.index] = keyframe
        self._index.add(keyframe.index, keyframe.features)

    def before(self, index: int) -> int | None:
        """Return the keyframe that was made before another; None for the first."""
        number = self._number[index]
        return self.order[number - 1] if number else None

    def steps_between(self, a: int, b: int) -> int:
        """Return how many keyframes later than a the keyframe b was made."""
        return self._number[b] - self._number[a]

    def query(
        self, features: Features, excluded: frozenset[int] = frozenset()
    ) -> list[PlaceCandidate]:
        """Return the keyframes that a frame's points recall, the likeliest first."""
        return self._index.query(features, excluded)

    def decode(self, index: int) -> PreparedFrame:
        """Return a keyframe ready to be compared."""
        return self._expander.decode(self._keyframes[index])

    def register(self, a: int, prepared: PreparedFrame, guess: Pose2) -> RegistrationResult:
        """Compare a frame with a keyframe; a link is of kind ``loop``."""
        keyframe = self.decode(a)
        trial = register(keyframe, prepared, guess, self._calibration, self._options)
        if trial.link is None:
            return trial
        # Boards of one print beside boards that differ: most of the floor must be the same. A floor
        # that was changed since then is known by the more points that agree on what is left of it.
        share = trial.correlation if math.isnan(trial.confirmed) else trial.confirmed
        many = trial.alignment.inlier_count >= self._options.convincing_inliers
        if share < (_MIN_CONFIRMED_BY_MANY if many else _MIN_CONFIRMED):
            reason = f"only {share:.0%} of the floor is as it was (to {keyframe.name})"
            return replace(trial, link=None, reason=reason)
        return replace(trial, link=replace(trial.link, kind="loop"))

    def is_reliable(self, trial: RegistrationResult) -> bool:
        """Return whether a comparison is to be believed without anything known beforehand."""
        needed = _MIN_INLIERS * self._options.matching.min_inliers
        return (
            trial.link is not None
            and trial.alignment.accepted
            and trial.alignment.inlier_count >= needed
            and trial.correlation >= _MIN_CORRELATION
        )

    def verify(
        self, prepared: PreparedFrame, places: Sequence[PlaceCandidate], graph: Backend
    ) -> Relocalization:
        """Compare a frame with the spots that it recalls; believe one spot or none."""
        spots: list[list[PlaceCandidate]] = []
        for place in places:
            if not graph.is_placed(place.keyframe):
                continue
            spot = next((s for s in spots if self._same_spot(s[0], place, graph)), None)
            if spot is None:
                spots.append([place])
            else:
                spot.append(place)
        tried = [self._first_strong(prepared, spot) for spot in spots[:_MAX_SPOTS]]
        believed: list[RegistrationResult] = []
        for trial in tried:
            if trial is not None and not any(self._same_end(trial, b, graph) for b in believed):
                believed.append(trial)
        if len(believed) == 1:
            return Relocalization(believed[0], "")
        if believed:
            return Relocalization(None, f"ambiguous: {len(believed)} spots of the map look like it")
        if not spots:
            return Relocalization(None, "not here: it recalls no place of the map")
        return Relocalization(
            None, f"not here: it resembles {len(spots)} spots of the map, but the pixels differ"
        )

    def _first_strong(
        self, prepared: PreparedFrame, spot: Sequence[PlaceCandidate]
    ) -> RegistrationResult | None:
        """Return the first comparison with a spot's keyframes that is to be believed."""
        for place in spot[:_PLACES_OF_A_SPOT]:
            trial = self.register(place.keyframe, prepared, place.keyframe_from_now)
            if self.is_reliable(trial):
                return trial
        return None

    def _same_end(
        self, first: RegistrationResult, second: RegistrationResult, graph: Backend
    ) -> bool:
        """Return whether two spots, compared, put the frame at one place: recalled only roughly."""
        assert first.link is not None
        assert second.link is not None
        return self._same_pose(
            (first.link.a, first.link.a_from_b), (second.link.a, second.link.a_from_b), graph
        )

    def _same_spot(self, first: PlaceCandidate, second: PlaceCandidate, graph: Backend) -> bool:
        """Return whether two recalled places say the same of where the frame is."""
        return self._same_pose(
            (first.keyframe, first.keyframe_from_now),
            (second.keyframe, second.keyframe_from_now),
            graph,
        )

    def _same_pose(
        self, first: tuple[int, Pose2], second: tuple[int, Pose2], graph: Backend
    ) -> bool:
        """Return whether two keyframes, with a frame's pose in each, put it at one place."""
        (a, a_from_now), (b, b_from_now) = first, second
        if graph[a].fragment != graph[b].fragment:
            return False
        one, other = graph.pose(a) @ a_from_now, graph.pose(b) @ b_from_now
        apart = one.inverse() @ other
        drift = _DRIFT_A_KEYFRAME * abs(self.steps_between(a, b))
        near = (_SAME_SHARE_OF_RANGE + drift) * self._calibration.max_range_metres
        return apart.translation_length < near and abs(apart.theta) < _SAME_RADIANS + drift
