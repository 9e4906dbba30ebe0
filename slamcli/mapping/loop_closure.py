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
from slamcli.core.records import Keyframe, Link, Prepared
from slamcli.mapping.backend.backend import Graph
from slamcli.mapping.keyframes import compress
from slamcli.mapping.relocalization import Recogniser, Recognition
from slamcli.stages import covisibility, posegraph
from slamcli.stages.place_index import Place

Attempts = Sequence["_Attempt"]
Spread = Callable[[Callable[[Attempts], list[Link]], Iterable[Attempts]], Iterable[list[Link]]]

# Of the way between two frames: what a calibration's errors add to it, which no link's covariance
# knows of (one sigma).
_DRIFT_SHARE = 0.01
# Matches are looked for within so much of the range about a guess; sigmas of the guess to that.
_GUESS_SHARE_OF_RANGE = 0.1
_GUESS_SIGMAS = 2.0
# A motion farther from what the poses say (chi-squared, 3 degrees of freedom, one in ten thousand)
# is not believed, whatever the pixels say.
_MOST_CONTRADICTION = 21.1
_LEAST_OVERLAP = 0.2
# So many loops are tried for a keyframe in a round, and none beside one that is closed already.
_MOST_TRIED = 3
_BESIDE = 1
_SAME_RADIANS = 0.1
# Pairs are listed for so many keyframes at a time.
_LISTED = 64


class _Attempt(NamedTuple):
    """Two keyframes to be compared, ``a_from_b`` as the poses have it, and how far to trust it."""

    a: int
    b: int
    expected: Pose2
    covariance: Float64Array
    guess: Pose2


class Loops:
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
        self._known = Recogniser(calibration, options, grid)
        self._recalled: dict[int, list[Place]] = {}
        self._asked: set[int] = set()
        self._ways: dict[int, float] = {}
        self._ties = _Ties(self._known)
        self._adopted: set[int] = set()
        self._failed: dict[tuple[int, int], Pose2] = {}

    @property
    def keyframes(self) -> list[Keyframe]:
        """All that are kept, in the order of their making."""
        return self._known.keyframes

    def remember(self, prepared: Prepared) -> None:
        """Keep one more keyframe, and what it recalls of those before the latest few."""
        if prepared.index in self._known:
            return
        keyframe = compress(prepared)
        recalled = self._known.recall(keyframe.features, self._latest())
        if recalled:
            self._recalled[keyframe.index] = recalled
        self._known.keep(keyframe)

    def adopt(self, keyframe: Keyframe) -> None:
        """Keep a keyframe of a finished map, whose own loops are closed."""
        self._known.keep(keyframe)
        self._asked.add(keyframe.index)
        self._adopted.add(keyframe.index)

    def recognise(self, prepared: Prepared, graph: Graph, *, after_break: bool) -> Recognition:
        """Find the place of a frame of which no pose is known.

        Parameters
        ----------
        prepared : Prepared
        graph : Graph
        after_break : bool
            Whether the frame before was lost too. If not, the latest keyframes are not asked: the
            frame has just been compared with them, and no robot turns about between two frames.
        """
        assert prepared.features is not None
        excluded = frozenset() if after_break else self._latest()
        places = self._known.recall(prepared.features, excluded)
        return self._known.believe(prepared, places, graph)

    def rejoin(self, prepared: Prepared, graph: Graph) -> Recognition:
        """Find the place of a new keyframe in another fragment than its own."""
        assert prepared.features is not None
        fragment = graph[prepared.index].fragment
        recalled = self._recalled.get(prepared.index, [])
        if any(graph[index].fragment != fragment for index in self._latest()):
            recalled = self._known.recall(prepared.features, frozenset([prepared.index]))
        places = [place for place in recalled if graph[place.keyframe].fragment != fragment]
        return self._known.believe(prepared, places, graph)

    def recur(self, keyframe: Prepared, graph: Graph) -> Link | None:
        """Return the loop that the latest keyframe, as placed, closes with floor that it recalls.

        Only the likeliest place is compared, where no link ties it to the keyframe already: that
        costs the same on a large map as on a small one.
        """
        b, fragment = keyframe.index, graph[keyframe.index].fragment
        self._ways[b] = self._way_to(b, graph)
        self._ties.update(graph.links)
        for place in self._recalled.get(b, [])[:1]:
            a = place.keyframe
            known = a in self._ways and graph.is_placed(a) and graph[a].fragment == fragment
            if known and not self._ties.beside(a, b):
                way = self._ways[b] - self._ways[a]
                return self._attempt(self._resembling(place, b, way, graph))
        return None

    def _way_to(self, keyframe: int, graph: Graph) -> float:
        """Return the way driven up to the latest keyframe, as far as the poses then told."""
        before = self._known.before(keyframe)
        if before is None or before not in self._ways:
            return 0.0
        step = 0.0
        if graph.is_placed(before) and graph[before].fragment == graph[keyframe].fragment:
            step = (graph.pose(before).inverse() @ graph.pose(keyframe)).translation_length
        return self._ways[before] + step

    def close(self, graph: Graph, spread: Spread = map) -> list[Link]:
        """Return the loops that one round finds by the graph's poses as they are.

        Parameters
        ----------
        graph : Graph
        spread : function
            Like `map`, such as an executor's. A keyframe's loops do not depend on those of others:
            only what it is tied to itself, among the older ones, is not asked for again.
        """
        ties = _Ties(self._known)
        found: list[Link] = []
        for attempts in (self._by_poses(graph), self._by_appearance(graph)):
            ties.update([*graph.links, *found])
            by_keyframe = (list(group) for _, group in groupby(attempts, lambda one: one.b))
            while listed := list(islice(by_keyframe, _LISTED)):
                for links in spread(partial(self._close_one, ties), listed):
                    found += links
        return found + self._between_fragments(graph)

    def _close_one(self, ties: _Ties, attempts: Sequence[_Attempt]) -> list[Link]:
        """Return the loops of one keyframe, none beside another."""
        found: list[Link] = []
        for attempt in attempts:
            if {attempt.a, attempt.b} <= self._adopted or ties.beside(attempt.a, attempt.b, found):
                continue
            link = self._attempt(attempt)
            if link is not None:
                found.append(link)
        return found

    def _latest(self) -> frozenset[int]:
        return frozenset(self._known.order[-self._recent :])

    def _by_poses(self, graph: Graph) -> Iterator[_Attempt]:
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
                least_overlap=_LEAST_OVERLAP,
                most_uncertainty=self._reach / _GUESS_SIGMAS,
            )
            for pair in candidates:
                b, tried = members[pair.b], 0
                for a, motion, sigma in zip(pair.a, pair.a_from_b, pair.uncertainties, strict=True):
                    steps = self._known.steps_between(members[a], b)
                    if steps <= self._recent or tried == _MOST_TRIED:
                        continue
                    tried += 1
                    expected = Pose2(*map(float, motion))
                    covariance = self._doubt(float(sigma))
                    yield _Attempt(members[a], b, expected, covariance, expected)

    def _by_appearance(self, graph: Graph) -> Iterator[_Attempt]:
        """Yield pairs of one fragment that look alike, where drift does not rule them out."""
        for members in self._fragments(graph).values():
            way = dict(zip(members, _ways([graph.pose(i) for i in members]), strict=True))
            for b in members:
                places = [p for p in self._recalled.get(b, []) if p.keyframe in way]
                for place in places[:_MOST_TRIED]:
                    yield self._resembling(place, b, way[b] - way[place.keyframe], graph)

    def _resembling(self, place: Place, b: int, way_metres: float, graph: Graph) -> _Attempt:
        """Return a keyframe and one that it recalls, so long a way before, as a pair to compare."""
        expected = graph.pose(place.keyframe).inverse() @ graph.pose(b)
        known, other = graph[place.keyframe].covariance, graph[b].covariance
        assert known is not None
        assert other is not None
        drift = self._doubt(_DRIFT_SHARE * abs(way_metres))
        covariance = posegraph.compose_covariance(known, expected, other) + drift
        return _Attempt(place.keyframe, b, expected, covariance, place.keyframe_from_now)

    def _between_fragments(self, graph: Graph) -> list[Link]:
        """Return the loops that tie keyframes to places in other fragments."""
        if len(self._fragments(graph)) < 2:
            return []
        links = []
        # What a keyframe looks like does not change from round to round: each is asked once.
        for index in self._known.order:
            if index not in self._asked and graph.is_placed(index):
                self._asked.add(index)
                found = self.rejoin(self._known.expand(index), graph).trial
                if found is not None and found.link is not None:
                    links.append(found.link)
        return links

    def _fragments(self, graph: Graph) -> dict[int, list[int]]:
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

    def _attempt(self, attempt: _Attempt) -> Link | None:
        """Compare two keyframes; None when nothing fits or it contradicts the poses."""
        pair = attempt.a, attempt.b
        failed = self._failed.get(pair)
        if failed is not None and self._near(failed, attempt.guess):
            return None
        trial = self._known.compare(attempt.a, self._known.expand(attempt.b), attempt.guess)
        surprising = not self._near(attempt.expected, attempt.guess)
        if (
            trial.link is None
            or (surprising and not self._known.is_strong(trial))
            or _contradiction(attempt, trial.link) > _MOST_CONTRADICTION
        ):
            self._failed[pair] = attempt.guess
            return None
        return trial.link

    def _near(self, first: Pose2, second: Pose2) -> bool:
        """Return whether a comparison about one guess looks where one about another would."""
        apart = first.inverse() @ second
        return (
            apart.translation_length < self._reach / _GUESS_SIGMAS
            and abs(apart.theta) < _SAME_RADIANS
        )


class _Ties:
    """Which keyframes links tie, to within a keyframe's step."""

    def __init__(self, known: Recogniser) -> None:
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


def _ways(poses: Sequence[Pose2]) -> list[float]:
    """Return the way driven up to each pose, metres."""
    steps = [path_length(pair) for pair in pairwise(poses)]
    return [0.0, *accumulate(steps)]


def _contradiction(attempt: _Attempt, link: Link) -> float:
    """Return the squared Mahalanobis distance of a measured motion from what the poses say."""
    error = attempt.expected.inverse() @ link.a_from_b
    vector = np.array([error.x, error.y, error.theta])
    return float(vector @ invert(attempt.covariance + link.covariance) @ vector)
