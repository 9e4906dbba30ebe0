"""Candidates for loop closure: from the poses with their uncertainty, and from appearance."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2, path_length, pose_array
from slamcli.core.records import Link
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.mapping.keyframes import KeyframeDatabase
from slamcli.stages import covisibility, posegraph
from slamcli.stages.place_index import PlaceCandidate

# Sigma of the drift by errors of the calibration, as a share of the path: no link's covariance
# contains it. [guarded by benchmarks/accuracy.py]
_DRIFT_SHARE = 0.01
# Radius about a guess within which matches are searched, as a share of the camera's range; and the
# number of the guess's sigmas that must fit in it. [guarded by benchmarks/accuracy.py]
_GUESS_SHARE_OF_RANGE = 0.1
_GUESS_SIGMAS = 2.0
# Least share of a keyframe's floor that an earlier one sees by the poses.
# [guarded by benchmarks/accuracy.py]
_MIN_OVERLAP = 0.2
# Candidates of a keyframe in one round. [guarded by benchmarks/scale.py]
_MAX_VERIFIED = 3


class LoopCandidate(NamedTuple):
    """Two keyframes to be registered.

    Attributes
    ----------
    a, b : int
        Keyframes, b the later one.
    expected : Pose2
        ``a_from_b`` by the poses.
    covariance : (3, 3) float64
        Of it: x, y (m), theta (rad).
    guess : Pose2
        ``a_from_b`` about which they are registered.
    """

    a: int
    b: int
    expected: Pose2
    covariance: Float64Array
    guess: Pose2


class LoopCandidates:
    """Proposes pairs of keyframes that may see the same floor.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    database : KeyframeDatabase

    Attributes
    ----------
    max_sigma_metres : float
        Largest position sigma of a guess about which matches are searched.
    """

    def __init__(
        self, calibration: Calibration, options: MapperOptions, database: KeyframeDatabase
    ) -> None:
        self._recent = options.recent_keyframes
        self._range_metres = calibration.max_range_metres
        self._reach_metres = _reach_metres(calibration)
        self.max_sigma_metres = max_sigma_metres(calibration)
        self._footprint = covisibility.Footprint(calibration)
        self._database = database

    def by_poses(self, graph: PoseGraphReader) -> Iterator[LoopCandidate]:
        """Yield pairs that see the same floor by their poses, where these are certain enough."""
        for members in self.fragments(graph).values():
            numbers = {index: number for number, index in enumerate(members)}
            links = [link for link in graph.links if link.a in numbers and link.b in numbers]
            ends = np.array([(numbers[k.a], numbers[k.b]) for k in links], np.int64).reshape(-1, 2)
            candidates = covisibility.pairs(
                pose_array([graph.pose(index) for index in members]),
                ends,
                np.array([_sigma_metres(link) for link in links]),
                self._footprint,
                min_overlap=_MIN_OVERLAP,
                max_uncertainty=self.max_sigma_metres,
            )
            for pair in candidates:
                b, listed = members[pair.b], 0
                for a, motion, sigma in zip(pair.a, pair.a_from_b, pair.uncertainties, strict=True):
                    steps = self._database.steps_between(members[a], b)
                    if steps <= self._recent or listed == _MAX_VERIFIED:
                        continue
                    listed += 1
                    expected = Pose2(*map(float, motion))
                    covariance = self._covariance(float(sigma))
                    yield LoopCandidate(members[a], b, expected, covariance, expected)

    def by_appearance(
        self, graph: PoseGraphReader, alike: Mapping[int, Sequence[PlaceCandidate]]
    ) -> Iterator[LoopCandidate]:
        """Yield pairs of one fragment that look alike.

        Parameters
        ----------
        graph : PoseGraphReader
        alike : mapping
            Of each keyframe, those before it that look like it.
        """
        for members in self.fragments(graph).values():
            lengths = _path_lengths([graph.pose(index) for index in members])
            driven_metres = dict(zip(members, lengths, strict=True))
            for b in members:
                near = [c for c in alike.get(b, []) if c.keyframe in driven_metres]
                for candidate in near[:_MAX_VERIFIED]:
                    metres = driven_metres[b] - driven_metres[candidate.keyframe]
                    yield self.by_votes(candidate, b, metres, graph)

    def by_votes(
        self, candidate: PlaceCandidate, b: int, driven_metres: float, graph: PoseGraphReader
    ) -> LoopCandidate:
        """Return a keyframe and one that looks like it, with the path between, as a candidate."""
        a = candidate.keyframe
        expected = graph.pose(a).inverse() @ graph.pose(b)
        covariance_a, covariance_b = graph[a].covariance, graph[b].covariance
        assert covariance_a is not None
        assert covariance_b is not None
        drift = self._covariance(_DRIFT_SHARE * abs(driven_metres))
        covariance = posegraph.compose_covariance(covariance_a, expected, covariance_b) + drift
        return LoopCandidate(a, b, expected, covariance, candidate.keyframe_from_now)

    def fragments(self, graph: PoseGraphReader) -> dict[int, list[int]]:
        """Return the placed keyframes of each fragment, in the order of insertion."""
        members: dict[int, list[int]] = {}
        for index in self._database.order:
            if graph.is_placed(index):
                members.setdefault(graph[index].fragment, []).append(index)
        return members

    def _covariance(self, sigma_metres: float) -> Float64Array:
        """Return the (3, 3) covariance of a motion with an error in metres within the range."""
        sigma = max(sigma_metres, _DRIFT_SHARE * self._reach_metres)
        return np.diag([sigma, sigma, sigma / self._range_metres]) ** 2


def max_sigma_metres(calibration: Calibration) -> float:
    """Return the largest position sigma of a guess about which matches are searched."""
    return _reach_metres(calibration) / _GUESS_SIGMAS


def _reach_metres(calibration: Calibration) -> float:
    return _GUESS_SHARE_OF_RANGE * calibration.max_range_metres


def _sigma_metres(link: Link) -> float:
    """Return a link's largest position sigma plus the drift by errors of the calibration."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(link.covariance[:2, :2])[1]))
    return sigma + _DRIFT_SHARE * link.a_from_b.translation_length


def _path_lengths(poses: Sequence[Pose2]) -> list[float]:
    """Return the path length up to each pose, metres."""
    steps = [path_length(pair) for pair in pairwise(poses)]
    return [0.0, *accumulate(steps)]
