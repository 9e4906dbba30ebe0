"""Where a frame may have been before, by what its points look like, at a cost that stays flat.

Descriptors are kept in hash tables, each keyed by some of their bits (locality-sensitive hashing:
Indyk and Motwani, STOC 1998); a bucket is read so deep and no deeper, so that a look-up costs the
same on a large map as on a small one. What is recalled votes for motions between the frame and a
keyframe: on a floor seen from above a true one keeps every distance between points (a rigid motion
of constant scale), and chance does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import Float32Array, Float64Array, Int32Array, Int64Array, UInt64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Features
from slamcli.core.robust import fit_rigid_2d

Kind = TypeVar("Kind", bound=np.generic)

# Keys so long that ten thousand keyframes leave three entries to a bucket: what is read grows
# little with a map, and twelve tables still find half of the descriptors that differ in an eighth.
_TABLES = 12
_KEY_BITS = 20
# So many entries of a bucket are read, the newest first.
_MAX_READ = 8
_MAX_INDEXED = 256
_MAX_ASKED = 400
# Descriptors of one spot differ by less than this share of their bits, those of others seldom.
_MAX_DIFFERENCE = 0.24
_MAX_OF_A_WORD = 24
_MAX_KEYFRAMES = 12
_MAX_MATCHES = 80
_MAX_HYPOTHESES = 200
_MIN_VOTES = 5
# Of the sigmas of two points, to a residual that they still agree with.
_AGREEING_SIGMAS = 4.0
# Two points nearer than this many tolerances turn a motion by chance.
_MIN_BASE = 10.0
_REFITS = 2
_FIRST_CAPACITY = 1024
_WORD_BYTES = 8
_REBUILT_AT_ONCE = 4096


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """A keyframe that a frame recalls.

    Attributes
    ----------
    keyframe : int
        As it was added.
    keyframe_from_now : Pose2
        Within a few sigmas of the points.
    votes : int
        Points of the frame that agree on that motion.
    """

    keyframe: int
    keyframe_from_now: Pose2
    votes: int


class PlaceIndex:
    """The points of many keyframes, to be found by their descriptors.

    All keyframes' features must be of one kind. Real-valued descriptors are made binary: a bit
    says whether an element is above the descriptor's median (Zhou et al., Scalar quantization for
    large scale image search, ACM Multimedia 2012).

    Parameters
    ----------
    seed : int
        Of the choice of the bits that key the tables.
    """

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        self._count = 0
        self._bits = np.empty((0, 0), np.int64)
        self._heads = np.empty((0, 0), np.int32)
        self._next = np.empty((0, _TABLES), np.int32)
        self._words = np.empty((0, 0), np.uint64)
        self._first_words = np.empty(0, np.uint64)
        self._points = np.empty((0, 3), np.float32)
        self._keyframe_of = np.empty(0, np.int32)

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the buckets, which are mostly empty and follow from the rest."""
        count = self._count
        return {
            **vars(self),
            "_heads": self._heads[:, :0],
            "_next": self._next[:0],
            "_words": self._words[:count],
            "_first_words": self._first_words[:count],
            "_points": self._points[:count],
            "_keyframe_of": self._keyframe_of[:count],
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if not self._bits.size:
            return
        self._heads = self._empty_heads()
        self._next = np.empty((self._count, _TABLES), np.int32)
        for first in range(0, self._count, _REBUILT_AT_ONCE):
            self._chain(self._words[first : first + _REBUILT_AT_ONCE], first)

    def add(self, keyframe: int, features: Features) -> None:
        """Remember a keyframe's strongest points under a number (32 bits) of the caller's."""
        chosen = _strongest(features, _MAX_INDEXED)
        if not len(chosen):
            return
        words = _words_of(features, chosen)
        if not self._bits.size:
            self._choose_bits(words.shape[1] * _WORD_BYTES * 8)
        first = self._count
        self._reserve(first + len(chosen), words.shape[1])
        entries = slice(first, first + len(chosen))
        self._words[entries] = words
        self._first_words[entries] = words[:, 0]
        self._points[entries] = _points_of(features, chosen)
        self._keyframe_of[entries] = keyframe
        self._chain(words, first)
        self._count += len(chosen)

    def query(
        self, features: Features, excluded: frozenset[int] = frozenset()
    ) -> list[PlaceCandidate]:
        """Return the keyframes whose points agree with a frame's on one motion, most votes first.

        Parameters
        ----------
        features : Features
        excluded : set of int
            Keyframes that are not asked for.
        """
        asked = _strongest(features, _MAX_ASKED)
        if not self._count or not len(asked):
            return []
        query, entry, difference = self._look_up(_words_of(features, asked))
        owner = self._keyframe_of[entry]
        if excluded:
            allowed = ~np.isin(owner, np.fromiter(excluded, np.int32, len(excluded)))
            query, entry, difference = query[allowed], entry[allowed], difference[allowed]
            owner = owner[allowed]
        keyframes, counts = np.unique(owner, return_counts=True)
        many = np.flatnonzero(counts >= _MIN_VOTES)
        most = many[np.lexsort((keyframes[many], -counts[many]))][:_MAX_KEYFRAMES]
        points = _points_of(features, asked)
        places = []
        for keyframe in keyframes[most]:
            mine = np.flatnonzero(owner == keyframe)
            mine = mine[np.lexsort((entry[mine], difference[mine]))]
            _, once = np.unique(query[mine], return_index=True)
            mine = mine[np.sort(once)][:_MAX_MATCHES]
            found = _agree(self._points[entry[mine]], points[query[mine]])
            if found is not None:
                places.append(PlaceCandidate(int(keyframe), *found))
        return sorted(places, key=lambda place: (-place.votes, place.keyframe))

    def _choose_bits(self, length: int) -> None:
        generator = np.random.default_rng(self._seed)
        key_bits = min(_KEY_BITS, length)
        self._bits = np.stack(
            [generator.choice(length, key_bits, replace=False) for _ in range(_TABLES)]
        )
        self._heads = self._empty_heads()

    def _empty_heads(self) -> Int32Array:
        return np.full((_TABLES, 2 ** self._bits.shape[1]), -1, np.int32)

    def _reserve(self, count: int, words: int) -> None:
        """Make room for so many entries; doubling makes that cheap on average."""
        capacity = len(self._next)
        if count <= capacity:
            return
        capacity = max(_FIRST_CAPACITY, 2 * capacity, count)
        self._next = _enlarged(self._next, (capacity, _TABLES))
        self._words = _enlarged(self._words, (capacity, words))
        self._first_words = _enlarged(self._first_words, (capacity,))
        self._points = _enlarged(self._points, (capacity, 3))
        self._keyframe_of = _enlarged(self._keyframe_of, (capacity,))

    def _keys(self, words: UInt64Array) -> Int64Array:
        """Return (N, tables): where each descriptor lies in each table."""
        bits = np.unpackbits(words.view(np.uint8), axis=1)
        weights = 1 << np.arange(self._bits.shape[1], dtype=np.int64)
        return np.asarray(bits[:, self._bits].astype(np.int64) @ weights)

    def _chain(self, words: UInt64Array, first: int) -> None:
        """Put entries, numbered from `first` on, in front of what their buckets hold already."""
        for table, keys in enumerate(self._keys(words).T):
            order = np.argsort(keys, kind="stable")
            ordered = keys[order]
            entries = (first + order).astype(np.int32)
            follows = np.r_[False, ordered[1:] == ordered[:-1]]
            heads = self._heads[table]
            before = np.where(follows, np.r_[np.int32(-1), entries[:-1]], heads[ordered])
            self._next[entries, table] = before
            last = np.r_[~follows[1:], True]
            heads[ordered[last]] = entries[last]

    def _look_up(self, words: UInt64Array) -> tuple[Int64Array, Int64Array, Int64Array]:
        """Return pairs (query, entry) of descriptors that are alike, and by how many bits not."""
        keys = self._keys(words)
        tables = np.arange(_TABLES)
        heads = self._heads[tables, keys]
        query, table = (index.astype(np.int64) for index in np.nonzero(heads >= 0))
        entry = heads[query, table].astype(np.int64)
        queries, entries = [query], [entry]
        for _ in range(_MAX_READ - 1):
            entry = self._next[entry, table].astype(np.int64)
            alive = entry >= 0
            query, table, entry = query[alive], table[alive], entry[alive]
            if not len(query):
                break
            queries.append(query)
            entries.append(entry)
        query, entry = np.concatenate(queries), np.concatenate(entries)
        # The first word alone tells most that share a key by chance, at a quarter of the cost.
        alike = np.bitwise_count(self._first_words[entry] ^ words[query, 0]) <= _MAX_OF_A_WORD
        query, entry = query[alike], entry[alike]
        unlike = np.bitwise_count(self._words[entry] ^ words[query]).sum(axis=1, dtype=np.int64)
        near = unlike <= _MAX_DIFFERENCE * 8 * _WORD_BYTES * words.shape[1]
        query, entry, unlike = query[near], entry[near], unlike[near]
        _, once = np.unique(query * self._count + entry, return_index=True)
        return query[once], entry[once], unlike[once]


def _strongest(features: Features, count: int) -> Int64Array:
    return np.sort(np.argsort(-features.scores, kind="stable")[:count])


def _points_of(features: Features, chosen: Int64Array) -> Float32Array:
    """Return (N, 3) float32: x, y and the larger sigma, metres."""
    return np.column_stack([features.points[chosen], features.sigmas[chosen].max(axis=1)])


def _words_of(features: Features, chosen: Int64Array) -> UInt64Array:
    """Return binary descriptors as (N, words of 64 bits)."""
    descriptors = features.descriptors[chosen]
    if features.norm == "l2":
        middle = np.median(descriptors, axis=1, keepdims=True)
        descriptors = np.packbits(descriptors > middle, axis=1)
    missing = -descriptors.shape[1] % _WORD_BYTES
    whole = np.pad(descriptors, ((0, 0), (0, missing)))
    return np.ascontiguousarray(whole).view(np.uint64)


def _enlarged(array: NDArray[Kind], shape: tuple[int, ...]) -> NDArray[Kind]:
    """Return the array with room for more; what is new is not set."""
    larger = np.empty(shape, array.dtype)
    if array.size:
        larger[: len(array)] = array
    return larger


def _agree(points_a: Float32Array, points_b: Float32Array) -> tuple[Pose2, int] | None:
    """Return the rigid motion ``a_from_b`` that most matched points agree with, and how many.

    Every pair of matches that keeps its distance gives a hypothesis; the longest ones are tried.

    Parameters
    ----------
    points_a, points_b : (M, 3) float32
        x, y and sigma, metres.
    """
    if len(points_a) < _MIN_VOTES:
        return None
    a, b = points_a[:, :2].astype(np.float64), points_b[:, :2].astype(np.float64)
    tolerance = _AGREEING_SIGMAS * np.hypot(points_a[:, 2], points_b[:, 2]).astype(np.float64)
    first, second = np.triu_indices(len(a), 1)
    base_a, base_b = a[second] - a[first], b[second] - b[first]
    length_a, length_b = np.hypot(*base_a.T), np.hypot(*base_b.T)
    slack = np.hypot(tolerance[first], tolerance[second])
    sound = (np.abs(length_a - length_b) < slack) & (length_a > _MIN_BASE * slack)
    pairs = np.flatnonzero(sound)
    if not len(pairs):
        return None
    # The longest pairs, for their tolerance, turn a motion least by their points' errors.
    pairs = pairs[np.argsort(-(length_a / slack)[pairs], kind="stable")[:_MAX_HYPOTHESES]]
    turns = np.arctan2(base_a[pairs, 1], base_a[pairs, 0])
    turns -= np.arctan2(base_b[pairs, 1], base_b[pairs, 0])
    middle_a = 0.5 * (a[first[pairs]] + a[second[pairs]])
    middle_b = 0.5 * (b[first[pairs]] + b[second[pairs]])
    residuals = _residuals(turns, middle_a, middle_b, a, b)
    inliers = residuals < tolerance
    votes = inliers.sum(axis=1)
    best = int(votes.argmax())
    pose, agree = Pose2(), inliers[best]
    for _ in range(_REFITS):
        if np.count_nonzero(agree) < _MIN_VOTES:
            return None
        pose = fit_rigid_2d(a[agree], b[agree], 1.0 / tolerance[agree] ** 2)
        agree = np.hypot(*(pose.apply(b) - a).T) < tolerance
    count = int(np.count_nonzero(agree))
    return (pose, count) if count >= _MIN_VOTES else None


def _residuals(
    turns: Float64Array,
    middle_a: Float64Array,
    middle_b: Float64Array,
    a: Float64Array,
    b: Float64Array,
) -> Float64Array:
    """Return (K, M) distances of matches under K motions that turn and carry one middle over."""
    cosine, sine = np.cos(turns)[:, None], np.sin(turns)[:, None]
    x = b[None, :, 0] - middle_b[:, :1]
    y = b[None, :, 1] - middle_b[:, 1:]
    away_x = cosine * x - sine * y + middle_a[:, :1] - a[None, :, 0]
    away_y = sine * x + cosine * y + middle_a[:, 1:] - a[None, :, 1]
    return np.hypot(away_x, away_y)
