"""Loop closure: candidates from poses and from appearance, verified by registration.

Where the poses, with their uncertainty, say that two keyframes see the same floor, they are
registered near that motion. Where they do not (drift, or a robot that was carried elsewhere), place
recognition proposes candidates (`slamcli.mapping.relocalization`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import chain, groupby, islice

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Pose2, squared_mahalanobis
from slamcli.core.records import Keyframe, Link, PreparedFrame
from slamcli.mapping.backend.pose_graph import PoseGraphReader
from slamcli.mapping.keyframes import KeyframeDatabase, encode_keyframe
from slamcli.mapping.loop_candidates import LoopCandidate, LoopCandidates
from slamcli.mapping.relocalization import Relocalization, Relocalizer, are_near
from slamcli.mapping.saved_state import LoopState
from slamcli.stages import dense
from slamcli.stages.place_index import PlaceCandidate

Candidates = Sequence[LoopCandidate]
Spread = Callable[[Callable[[Candidates], list[Link]], Iterable[Candidates]], Iterable[list[Link]]]

# A loop farther from the poses' motion is rejected, whatever the pixels say: chi-squared with 3
# degrees of freedom, one in ten thousand.
_MAX_SQUARED_MAHALANOBIS = 21.1
# A candidate this near to a linked keyframe, in keyframes, is skipped.
# [guarded by benchmarks/scale.py]
_MAX_STEPS_BESIDE = 1
# Registrations about guesses that differ by less search the same motions.
_SAME_RADIANS = 0.1
# Keyframes that were inserted so few steps before or after one are about it: steps link them.
_STEPS_ABOUT = 2
# Keyframes whose candidates are listed at a time: bounds the memory [benchmarks/scale.py].
_KEYFRAMES_AT_ONCE = 1024


class LoopCloser:
    """Links keyframes that saw the same floor at different times.

    Parameters
    ----------
    calibration : Calibration
    options : MapperOptions
    relocalizer : Relocalizer
        Keyframes are added to its database.
    """

    def __init__(
        self, calibration: Calibration, options: MapperOptions, relocalizer: Relocalizer
    ) -> None:
        self._recent = options.recent_keyframes
        self._relocalizer = relocalizer
        self._database = relocalizer.database
        self._proposals = LoopCandidates(calibration, options, relocalizer.database)
        self._alike: dict[int, list[PlaceCandidate]] = {}
        self._linked = _LinkedKeyframes(self._database)
        self._path_lengths_metres: dict[int, float] = {}
        # Keyframes of a finished map, whose loops are closed; those that were searched for in other
        # fragments; and the guesses about which pairs did not fit.
        self._known: set[int] = set()
        self._searched: set[int] = set()
        self._failed: dict[tuple[int, int], Pose2] = {}

    def add(self, prepared: PreparedFrame) -> None:
        """Insert a keyframe, and find those that look like it before the latest few."""
        if prepared.index in self._database:
            return
        keyframe = encode_keyframe(prepared)
        candidates = self._database.query(keyframe.features, self._latest())
        if candidates:
            self._alike[keyframe.index] = candidates
        self._database.add(keyframe)

    def add_known(self, keyframe: Keyframe) -> None:
        """Insert a keyframe of a finished map, whose own loops are closed."""
        self._database.add(keyframe)
        self._searched.add(keyframe.index)
        self._known.add(keyframe.index)

    def state(self) -> LoopState:
        """Return all that `restore` needs."""
        return LoopState(
            self._database.keyframes,
            self._alike,
            self._linked.linked,
            self._linked.count,
            self._path_lengths_metres,
            tuple(sorted(self._known)),
            tuple(sorted(self._searched)),
            self._failed,
        )

    def restore(self, state: LoopState) -> None:
        """Take over the state of another loop closer, before any keyframe was added."""
        for keyframe in state.keyframes:
            if keyframe.index not in self._database:
                self._database.add(keyframe)
        self._alike = dict(state.alike)
        self._linked.linked = {index: list(others) for index, others in state.linked.items()}
        self._linked.count = state.counted_links
        self._path_lengths_metres = dict(state.path_lengths_metres)
        self._known, self._searched = set(state.known), set(state.searched)
        self._failed = dict(state.failed)

    def relocalize(
        self, prepared: PreparedFrame, graph: PoseGraphReader, *, after_break: bool
    ) -> Relocalization:
        """Find a frame with no pose prior.

        Parameters
        ----------
        prepared : PreparedFrame
        graph : PoseGraphReader
        after_break : bool
            Whether the frame before was lost too. If not, the latest keyframes are excluded: the
            frame has just been registered to them, and no robot turns about between two frames.
        """
        assert prepared.features is not None
        excluded = frozenset() if after_break else self._latest()
        candidates = self._relocalizer.query(prepared.features, excluded)
        return self._relocalizer.verify(prepared, candidates, graph)

    def join_fragments(self, prepared: PreparedFrame, graph: PoseGraphReader) -> Relocalization:
        """Find a new keyframe in another fragment than its own."""
        assert prepared.features is not None
        fragment = graph[prepared.index].fragment
        candidates = self._alike.get(prepared.index, [])
        if any(graph[index].fragment != fragment for index in self._latest()):
            candidates = self._relocalizer.query(prepared.features, frozenset([prepared.index]))
        others = [c for c in candidates if graph[c.keyframe].fragment != fragment]
        return self._relocalizer.verify(prepared, others, graph)

    def close_on_arrival(self, keyframe: PreparedFrame, graph: PoseGraphReader) -> Link | None:
        """Return the loop that the latest keyframe, as placed, closes in its fragment; or None.

        Only the candidate with most votes is verified, unless the two are linked already: the cost
        is the same on a large map as on a small one.
        """
        b, fragment = keyframe.index, graph[keyframe.index].fragment
        self._path_lengths_metres[b] = self._path_length_to(b, graph)
        self._linked.update(graph.links)
        for candidate in self._alike.get(b, [])[:1]:
            a = candidate.keyframe
            if (
                a in self._path_lengths_metres
                and graph.is_placed(a)
                and graph[a].fragment == fragment
                and not self._linked.beside(a, b)
            ):
                driven_metres = self._path_lengths_metres[b] - self._path_lengths_metres[a]
                return self._verify(self._proposals.by_votes(candidate, b, driven_metres, graph))
        return None

    def connected(self, keyframe: int, graph: PoseGraphReader) -> list[int]:
        """Return the keyframes about those that loops and steps connect with one, in their order.

        Of its own fragment, without itself: where they lie is certain.
        """
        self._linked.update(graph.links)
        about = self._database.around(
            [keyframe, *self._linked.linked.get(keyframe, [])], _STEPS_ABOUT
        )
        fragment = graph[keyframe].fragment
        return sorted(
            index
            for index in about - {keyframe}
            if graph.is_placed(index) and graph[index].fragment == fragment
        )

    def decode(self, keyframe: int) -> PreparedFrame:
        """Return a stored keyframe ready for registration; raises FrameError if it is damaged."""
        return self._database.decode(keyframe)

    def find_loops(self, graph: PoseGraphReader, spread: Spread = map) -> list[Link]:
        """Return the loops that one round finds by the graph's poses as they are.

        Parameters
        ----------
        graph : PoseGraphReader
        spread : function
            Like `map`, such as an executor's. A keyframe's loops do not depend on those of others:
            only its own earlier links are skipped.
        """
        linked = _LinkedKeyframes(self._database)
        found: list[Link] = []
        for candidates in (
            self._proposals.by_poses(graph),
            self._proposals.by_appearance(graph, self._alike),
        ):
            linked.update([*graph.links, *found])
            by_keyframe = (list(group) for _, group in groupby(candidates, lambda one: one.b))
            while listed := list(islice(by_keyframe, _KEYFRAMES_AT_ONCE)):
                # Those of one place after one another, whose candidates are decoded once.
                order = sorted(range(len(listed)), key=lambda n: min(one.a for one in listed[n]))
                by_place = [listed[number] for number in order]
                verified = spread(partial(self._verify_keyframe, linked), by_place)
                links_of = dict(zip(order, verified, strict=True))
                found += chain.from_iterable(links_of[number] for number in range(len(listed)))
        return found + self._between_fragments(graph)

    def _verify_keyframe(self, linked: _LinkedKeyframes, candidates: Candidates) -> list[Link]:
        """Return the loops of one keyframe, none beside another."""
        found: list[Link] = []
        for candidate in candidates:
            if {candidate.a, candidate.b} <= self._known or linked.beside(
                candidate.a, candidate.b, found
            ):
                continue
            link = self._verify(candidate)
            if link is not None:
                found.append(link)
        return found

    def _latest(self) -> frozenset[int]:
        return self._database.latest(self._recent)

    def _path_length_to(self, keyframe: int, graph: PoseGraphReader) -> float:
        """Return the metres driven up to the latest keyframe, by the poses at that time."""
        before = self._database.before(keyframe)
        if before is None or before not in self._path_lengths_metres:
            return 0.0
        step = 0.0
        if graph.is_placed(before) and graph[before].fragment == graph[keyframe].fragment:
            step = (graph.pose(before).inverse() @ graph.pose(keyframe)).translation_length
        return self._path_lengths_metres[before] + step

    def _between_fragments(self, graph: PoseGraphReader) -> list[Link]:
        """Return the loops from keyframes to other fragments."""
        if len(self._proposals.fragments(graph)) < 2:
            return []
        links = []
        # A keyframe's appearance does not change from round to round: each is searched for once.
        for index in self._database.order:
            if index not in self._searched and graph.is_placed(index):
                self._searched.add(index)
                try:
                    keyframe = self._database.decode(index)
                except FrameError:  # its pictures, from a damaged map
                    continue
                link = self.join_fragments(keyframe, graph).link
                if link is not None:
                    links.append(link)
        return links

    def _verify(self, candidate: LoopCandidate) -> Link | None:
        """Register two keyframes; None when nothing fits or the fit contradicts the poses."""
        pair = candidate.a, candidate.b
        failed = self._failed.get(pair)
        if failed is not None and self._near(failed, candidate.guess):
            return None
        prior = dense.MotionPrior(candidate.expected, candidate.covariance)
        expected = self._near(candidate.expected, candidate.guess)
        # All that a registration about the guess may find would contradict the poses.
        if not expected and contradicts(prior, candidate.guess, self._searched_covariance()):
            self._failed[pair] = candidate.guess
            return None
        try:
            prepared = self._database.decode(candidate.b)
            register = self._relocalizer.register_reliably
            result = None
            if expected:
                register = self._relocalizer.register
                result = self._relocalizer.track(candidate.a, prepared, prior)
            if result is None:
                result = register(candidate.a, prepared, candidate.guess, prior)
        except FrameError:  # the keyframe's pictures, from a damaged map
            self._failed[pair] = candidate.guess
            return None
        if (
            result is None
            or result.link is None
            or contradicts(prior, result.link.a_from_b, result.link.covariance)
        ):
            self._failed[pair] = candidate.guess
            return None
        return result.link

    def _searched_covariance(self) -> Float64Array:
        """Return (3, 3): how far from a guess a registration searches, as a covariance."""
        sigma_metres = self._proposals.max_sigma_metres
        return np.diag([sigma_metres, sigma_metres, _SAME_RADIANS]) ** 2

    def _near(self, first: Pose2, second: Pose2) -> bool:
        """Return whether registrations about two guesses search the same motions."""
        return are_near(first, second, self._proposals.max_sigma_metres, _SAME_RADIANS)


class _LinkedKeyframes:
    """Which keyframes are linked, up to neighbouring keyframes.

    Attributes
    ----------
    linked : dict of int to list of int
    count : int
        Links of the graph that it has.
    """

    def __init__(self, database: KeyframeDatabase) -> None:
        self._database = database
        self.linked: dict[int, list[int]] = {}
        self.count = 0

    def update(self, links: Sequence[Link]) -> None:
        """Add the links since the last update; links are never removed."""
        for link in links[self.count :]:
            if link.a in self._database and link.b in self._database:
                self.linked.setdefault(link.a, []).append(link.b)
                self.linked.setdefault(link.b, []).append(link.a)
        self.count = len(links)

    def beside(self, a: int, b: int, more: Sequence[Link] = ()) -> bool:
        """Return whether b is linked to a already, or to a keyframe right before or after it.

        Parameters
        ----------
        a, b : int
            Keyframes.
        more : sequence of Link
            More links of b with older ones.
        """
        others = [*self.linked.get(b, []), *(link.a for link in more)]
        return any(
            abs(self._database.steps_between(other, a)) <= _MAX_STEPS_BESIDE for other in others
        )


def contradicts(prior: dense.MotionPrior, a_from_b: Pose2, covariance: Float64Array) -> bool:
    """Return whether a motion is too far from that which the poses predict.

    Parameters
    ----------
    prior : MotionPrior
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of that motion, in b's own axes.
    """
    apart = squared_mahalanobis(prior.a_from_b, prior.covariance + covariance, a_from_b)
    return apart > _MAX_SQUARED_MAHALANOBIS
