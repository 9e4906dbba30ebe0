"""Floor seen before: candidates from poses and from appearance, compared before any is believed.

A drive's keyframes are kept for good. Where the poses, as sure as they are, say that two of them
see the same floor, they are compared near that guess. Where they do not say so (drift, or a robot
that was carried elsewhere), a frame's points recall places, and the motion that they vote for is
compared (`slamcli.mapping.relocalization`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import accumulate, groupby, islice, pairwise
from typing import NamedTuple

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Grid, Pose2, invert, path_length, pose_array
from slamcli.core.records import Keyframe, Link, PreparedFrame
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.keyframes import encode_keyframe
from slamcli.mapping.relocalization import Relocalization, Relocalizer
from slamcli.stages import covisibility, posegraph
from slamcli.stages.place_index import PlaceCandidate

Attempts = Sequence["_LoopCandidate"]
Spread = Callable[[Callable[[Attempts], list[Link]], Iterable[Attempts]], Iterable[list[Link]]]

# Of the way between two frames: what a calibration's errors add to it, which no link's covariance
# knows of (one sigma).
_DRIFT_SHARE = 0.01
# Matches are looked for within so much of the range about a guess; sigmas of the guess to that.
_GUESS_SHARE_OF_RANGE = 0.1
_GUESS_SIGMAS = 2.0
# A motion farther from what the poses say (chi-squared, 3 degrees of freedom, one in ten thousand)
# is not believed, whatever the pixels say.
_MAX_CONTRADICTION = 21.1
_MIN_OVERLAP = 0.2
# So many loops are tried for a keyframe in a round, and none beside one that is closed already.
_MAX_TRIED = 3
_BESIDE = 1
_SAME_RADIANS = 0.1
# Pairs are listed for so many keyframes at a time.
_LISTED = 64


class _LoopCandidate(NamedTuple):
    """Two keyframes to be compared, ``a_from_b`` as the poses have it, and how far to trust it."""

    a: int
    b: int
    expected: Pose2
    covariance: Float64Array
    guess: Pose2


class LoopCloser:
    """Keeps a drive's keyframes and ties those that saw the same floor at different times.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    grid : Grid
        Of the views.
    """

    def __init__(self, calibration: Calibration, options: MapperOptions, grid: Grid) -> None:
        self._recent = options.recent_keyframes
        self._range = calibration.max_range_metres
        self._reach = _GUESS_SHARE_OF_RANGE * calibration.max_range_metres
        self._footprint = covisibility.Footprint(calibration)
        self._known = Relocalizer(calibration, options, grid)
        self._candidates: dict[int, list[PlaceCandidate]] = {}
        self._asked: set[int] = set()
        self._path_lengths: dict[int, float] = {}
        self._linked = _LinkedKeyframes(self._known)
        self._adopted: set[int] = set()
        self._failed: dict[tuple[int, int], Pose2] = {}

    @property
    def keyframes(self) -> list[Keyframe]:
        """All that are kept, in the order of their making."""
        return self._known.keyframes

    def add(self, prepared: PreparedFrame) -> None:
        """Keep one more keyframe, and what it recalls of those before the latest few."""
        if prepared.index in self._known:
            return
        keyframe = encode_keyframe(prepared)
        candidates = self._known.query(keyframe.features, self._latest())
        if candidates:
            self._candidates[keyframe.index] = candidates
        self._known.add(keyframe)

    def add_known(self, keyframe: Keyframe) -> None:
        """Keep a keyframe of a finished map, whose own loops are closed."""
        self._known.add(keyframe)
        self._asked.add(keyframe.index)
        self._adopted.add(keyframe.index)

    def relocalize(
        self, prepared: PreparedFrame, graph: Backend, *, after_break: bool
    ) -> Relocalization:
        """Find the place of a frame of which no pose is known.

        Parameters
        ----------
        prepared : PreparedFrame
        graph : Backend
        after_break : bool
            Whether the frame before was lost too. If not, the latest keyframes are not asked: the
            frame has just been compared with them, and no robot turns about between two frames.
        """
        assert prepared.features is not None
        excluded = frozenset() if after_break else self._latest()
        places = self._known.query(prepared.features, excluded)
        return self._known.verify(prepared, places, graph)

    def join_fragments(self, prepared: PreparedFrame, graph: Backend) -> Relocalization:
        """Find the place of a new keyframe in another fragment than its own."""
        assert prepared.features is not None
        fragment = graph[prepared.index].fragment
        candidates = self._candidates.get(prepared.index, [])
        if any(graph[index].fragment != fragment for index in self._latest()):
            candidates = self._known.query(prepared.features, frozenset([prepared.index]))
        places = [place for place in candidates if graph[place.keyframe].fragment != fragment]
        return self._known.verify(prepared, places, graph)

    def close_on_arrival(self, keyframe: PreparedFrame, graph: Backend) -> Link | None:
        """Return the loop that the latest keyframe, as placed, closes with floor that it recalls.

        Only the likeliest place is compared, where no link ties it to the keyframe already: that
        costs the same on a large map as on a small one.
        """
        b, fragment = keyframe.index, graph[keyframe.index].fragment
        self._path_lengths[b] = self._way_to(b, graph)
        self._linked.update(graph.links)
        for place in self._candidates.get(b, [])[:1]:
            a = place.keyframe
            known = a in self._path_lengths and graph.is_placed(a) and graph[a].fragment == fragment
            if known and not self._linked.beside(a, b):
                way = self._path_lengths[b] - self._path_lengths[a]
                return self._verify(self._resembling(place, b, way, graph))
        return None

    def _way_to(self, keyframe: int, graph: Backend) -> float:
        """Return the way driven up to the latest keyframe, as far as the poses then told."""
        before = self._known.before(keyframe)
        if before is None or before not in self._path_lengths:
            return 0.0
        step = 0.0
        if graph.is_placed(before) and graph[before].fragment == graph[keyframe].fragment:
            step = (graph.pose(before).inverse() @ graph.pose(keyframe)).translation_length
        return self._path_lengths[before] + step

    def find_loops(self, graph: Backend, spread: Spread = map) -> list[Link]:
        """Return the loops that one round finds by the graph's poses as they are.

        Parameters
        ----------
        graph : Backend
        spread : function
            Like `map`, such as an executor's. A keyframe's loops do not depend on those of others:
            only what it is tied to itself, among the older ones, is not asked for again.
        """
        ties = _LinkedKeyframes(self._known)
        found: list[Link] = []
        for attempts in (self._by_poses(graph), self._by_appearance(graph)):
            ties.update([*graph.links, *found])
            by_keyframe = (list(group) for _, group in groupby(attempts, lambda one: one.b))
            while listed := list(islice(by_keyframe, _LISTED)):
                for links in spread(partial(self._close_one, ties), listed):
                    found += links
        return found + self._between_fragments(graph)

    def _close_one(self, ties: _LinkedKeyframes, attempts: Sequence[_LoopCandidate]) -> list[Link]:
        """Return the loops of one keyframe, none beside another."""
        found: list[Link] = []
        for candidate in attempts:
            if {candidate.a, candidate.b} <= self._adopted or ties.beside(
                candidate.a, candidate.b, found
            ):
                continue
            link = self._verify(candidate)
            if link is not None:
                found.append(link)
        return found

    def _latest(self) -> frozenset[int]:
        return frozenset(self._known.order[-self._recent :])

    def _by_poses(self, graph: Backend) -> Iterator[_LoopCandidate]:
        """Yield pairs that see the same floor, if the poses are right, and surely enough so."""
        for members in self._fragments(graph).values():
            numbers = {index: number for number, index in enumerate(members)}
            ties = [link for link in graph.links if link.a in numbers and link.b in numbers]
            tied = np.array([(numbers[t.a], numbers[t.b]) for t in ties], np.int64).reshape(-1, 2)
            candidates = covisibility.pairs(
                pose_array([graph.pose(index) for index in members]),
                tied,
                np.array([_uncertainty(tie) for tie in ties]),
                self._footprint,
                min_overlap=_MIN_OVERLAP,
                max_uncertainty=self._reach / _GUESS_SIGMAS,
            )
            for pair in candidates:
                b, tried = members[pair.b], 0
                for a, motion, sigma in zip(pair.a, pair.a_from_b, pair.uncertainties, strict=True):
                    steps = self._known.steps_between(members[a], b)
                    if steps <= self._recent or tried == _MAX_TRIED:
                        continue
                    tried += 1
                    expected = Pose2(*map(float, motion))
                    covariance = self._doubt(float(sigma))
                    yield _LoopCandidate(members[a], b, expected, covariance, expected)

    def _by_appearance(self, graph: Backend) -> Iterator[_LoopCandidate]:
        """Yield pairs of one fragment that look alike, where drift does not rule them out."""
        for members in self._fragments(graph).values():
            way = dict(zip(members, _path_lengths([graph.pose(i) for i in members]), strict=True))
            for b in members:
                places = [p for p in self._candidates.get(b, []) if p.keyframe in way]
                for place in places[:_MAX_TRIED]:
                    yield self._resembling(place, b, way[b] - way[place.keyframe], graph)

    def _resembling(
        self, place: PlaceCandidate, b: int, path_length_metres: float, graph: Backend
    ) -> _LoopCandidate:
        """Return a keyframe and one that it recalls, so long a way before, as a pair to compare."""
        expected = graph.pose(place.keyframe).inverse() @ graph.pose(b)
        known, other = graph[place.keyframe].covariance, graph[b].covariance
        assert known is not None
        assert other is not None
        drift = self._doubt(_DRIFT_SHARE * abs(path_length_metres))
        covariance = posegraph.compose_covariance(known, expected, other) + drift
        return _LoopCandidate(place.keyframe, b, expected, covariance, place.keyframe_from_now)

    def _between_fragments(self, graph: Backend) -> list[Link]:
        """Return the loops that tie keyframes to places in other fragments."""
        if len(self._fragments(graph)) < 2:
            return []
        links = []
        # What a keyframe looks like does not change from round to round: each is asked once.
        for index in self._known.order:
            if index not in self._asked and graph.is_placed(index):
                self._asked.add(index)
                found = self.join_fragments(self._known.decode(index), graph).trial
                if found is not None and found.link is not None:
                    links.append(found.link)
        return links

    def _fragments(self, graph: Backend) -> dict[int, list[int]]:
        members: dict[int, list[int]] = {}
        for index in self._known.order:
            if graph.is_placed(index):
                members.setdefault(graph[index].fragment, []).append(index)
        return members

    def _doubt(self, sigma_metres: float) -> Float64Array:
        """Return the (3, 3) covariance of a motion that errs by so much within the range."""
        sigma = max(sigma_metres, _DRIFT_SHARE * self._reach)
        turn = sigma / self._range
        return np.diag([sigma, sigma, turn]) ** 2

    def _verify(self, candidate: _LoopCandidate) -> Link | None:
        """Compare two keyframes; None when nothing fits or it contradicts the poses."""
        pair = candidate.a, candidate.b
        failed = self._failed.get(pair)
        if failed is not None and self._near(failed, candidate.guess):
            return None
        trial = self._known.register(candidate.a, self._known.decode(candidate.b), candidate.guess)
        surprising = not self._near(candidate.expected, candidate.guess)
        if (
            trial.link is None
            or (surprising and not self._known.is_reliable(trial))
            or _contradiction(candidate, trial.link) > _MAX_CONTRADICTION
        ):
            self._failed[pair] = candidate.guess
            return None
        return trial.link

    def _near(self, first: Pose2, second: Pose2) -> bool:
        """Return whether a comparison about one guess looks where one about another would."""
        apart = first.inverse() @ second
        return (
            apart.translation_length < self._reach / _GUESS_SIGMAS
            and abs(apart.theta) < _SAME_RADIANS
        )


class _LinkedKeyframes:
    """Which keyframes links tie, to within a keyframe's step."""

    def __init__(self, known: Relocalizer) -> None:
        self._known = known
        self._tied: dict[int, list[int]] = {}
        self._count = 0

    def update(self, links: Sequence[Link]) -> None:
        """Take in the links that have come since; a link that is there stays for good."""
        for link in links[self._count :]:
            if link.a in self._known and link.b in self._known:
                self._tied.setdefault(link.a, []).append(link.b)
                self._tied.setdefault(link.b, []).append(link.a)
        self._count = len(links)

    def beside(self, a: int, b: int, more: Sequence[Link] = ()) -> bool:
        """Return whether b is tied to a already, or to a keyframe right before or after it.

        Parameters
        ----------
        a, b : int
            Keyframes.
        more : sequence of Link
            Of b with older ones, to be counted too.
        """
        others = [*self._tied.get(b, []), *(link.a for link in more)]
        return any(abs(self._known.steps_between(other, a)) <= _BESIDE for other in others)


def _uncertainty(link: Link) -> float:
    """Return metres that a link may err by: its own sigma and a calibration's share."""
    sigma = float(np.sqrt(np.linalg.eigvalsh(link.covariance[:2, :2])[1]))
    return sigma + _DRIFT_SHARE * link.a_from_b.translation_length


def _path_lengths(poses: Sequence[Pose2]) -> list[float]:
    """Return the way driven up to each pose, metres."""
    steps = [path_length(pair) for pair in pairwise(poses)]
    return [0.0, *accumulate(steps)]


def _contradiction(candidate: _LoopCandidate, link: Link) -> float:
    """Return the squared Mahalanobis distance of a measured motion from what the poses say."""
    error = candidate.expected.inverse() @ link.a_from_b
    vector = np.array([error.x, error.y, error.theta])
    return float(vector @ invert(candidate.covariance + link.covariance) @ vector)
