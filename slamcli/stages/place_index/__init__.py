"""Place recognition by binary descriptors, at a cost that does not grow with the map.

Descriptors are in hash tables, each keyed by some of their bits (locality-sensitive hashing: Indyk
and Motwani, STOC 1998). A bounded number of entries of a bucket is read, so that a query costs the
same on a large map as on a small one. The matches of a keyframe vote for its motion to the frame
(`voting`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import Float32Array, Int32Array, Int64Array, UInt64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Features
from slamcli.stages.place_index.voting import MIN_VOTES, vote

Kind = TypeVar("Kind", bound=np.generic)

# With keys of this length, ten thousand keyframes have three entries in a bucket: what is read
# grows little with a map, and twelve tables still find half of the descriptors that differ in an
# eighth of their bits.
# [benchmarks/backend.py: 2.1 ms a query with 1,000 keyframes, 2.6 ms with 10,000]
_TABLES = 12
_KEY_BITS = 20
# Entries of a bucket that are read, the newest first.
_MAX_READ = 8
# Points of a keyframe that are indexed, and of a frame that are queried: the strongest ones.
# [benchmarks/locate.py: 500 of 500 frames found]
_MAX_INDEXED = 256
_MAX_QUERIED = 400
# Descriptors of one point differ by less than this share of their bits, those of others seldom; and
# in their first word by at most so many bits. [guarded by benchmarks/locate.py]
_MAX_DIFFERENCE = 0.24
_MAX_WORD_DIFFERENCE_BITS = 24
# Keyframes that are voted on, and matches of each. [guarded by benchmarks/locate.py]
_MAX_KEYFRAMES = 12
_MAX_MATCHES = 80
_FIRST_CAPACITY = 1024
_WORD_BYTES = 8
# Entries that are hashed at a time when an index is unpickled: bounds the memory.
_REBUILT_AT_ONCE = 4096


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """A keyframe that looks like a frame, and the motion between them.

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


@dataclass(frozen=True, slots=True, eq=False)
class PlaceMatches:
    """The keyframes that have most matches with a frame, not yet voted on.

    Attributes
    ----------
    keyframes : tuple of int
        Most matches first.
    points_a, points_b : tuple of (M, 3) float32
        Matched points of each keyframe and of the frame, the most similar first: x, y and the
        larger sigma, metres.
    """

    keyframes: tuple[int, ...]
    points_a: tuple[Float32Array, ...]
    points_b: tuple[Float32Array, ...]

    def vote(self, number: int) -> PlaceCandidate | None:
        """Return the motion that one keyframe's matches vote for, given its number among them."""
        found = vote(self.points_a[number], self.points_b[number])
        return None if found is None else PlaceCandidate(self.keyframes[number], *found)


class PlaceIndex:
    """Index of the points of many keyframes by their descriptors.

    All keyframes' features must be of one kind. Real-valued descriptors are made binary: a bit
    is set where an element is above the descriptor's median (Zhou et al., Scalar quantization for
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
        """Return all but the buckets, which are mostly empty and are computed from the rest."""
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
        """Insert a keyframe's strongest points under a number (32 bits) of the caller's."""
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
            Keyframes to leave out.
        """
        matches = self.match(features, excluded)
        votes = map(matches.vote, range(len(matches.keyframes)))
        candidates = [candidate for candidate in votes if candidate is not None]
        return sorted(candidates, key=lambda one: (-one.votes, one.keyframe))

    def match(self, features: Features, excluded: frozenset[int] = frozenset()) -> PlaceMatches:
        """Return the matches that `query` votes on."""
        queried = _strongest(features, _MAX_QUERIED)
        if not self._count or not len(queried):
            return PlaceMatches((), (), ())
        query, entry, difference = self._look_up(_words_of(features, queried))
        owner = self._keyframe_of[entry]
        if excluded:
            allowed = ~np.isin(owner, np.fromiter(excluded, np.int32, len(excluded)))
            query, entry, difference = query[allowed], entry[allowed], difference[allowed]
            owner = owner[allowed]
        keyframes, counts = np.unique(owner, return_counts=True)
        many = np.flatnonzero(counts >= MIN_VOTES)
        most = keyframes[many[np.lexsort((keyframes[many], -counts[many]))][:_MAX_KEYFRAMES]]
        points = _points_of(features, queried)
        points_a, points_b = [], []
        for keyframe in most:
            mine = np.flatnonzero(owner == keyframe)
            mine = mine[np.lexsort((entry[mine], difference[mine]))]
            _, once = np.unique(query[mine], return_index=True)
            mine = mine[np.sort(once)][:_MAX_MATCHES]
            points_a.append(self._points[entry[mine]])
            points_b.append(points[query[mine]])
        return PlaceMatches(tuple(most.tolist()), tuple(points_a), tuple(points_b))

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
        """Make room for a number of entries; doubling makes that cheap on average."""
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
        """Return (N, tables): the key of each descriptor in each table."""
        bits = np.unpackbits(words.view(np.uint8), axis=1)
        weights = 1 << np.arange(self._bits.shape[1], dtype=np.int64)
        return np.asarray(bits[:, self._bits].astype(np.int64) @ weights)

    def _chain(self, words: UInt64Array, first: int) -> None:
        """Insert entries, numbered from `first` on, at the front of their buckets."""
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
        """Return pairs (query, entry) of similar descriptors, and the bits by which they differ."""
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
        # The first word alone rejects most that share a key by chance, at a quarter of the cost.
        similar = (
            np.bitwise_count(self._first_words[entry] ^ words[query, 0])
            <= _MAX_WORD_DIFFERENCE_BITS
        )
        query, entry = query[similar], entry[similar]
        different_bits = np.bitwise_count(self._words[entry] ^ words[query]).sum(
            axis=1, dtype=np.int64
        )
        near = different_bits <= _MAX_DIFFERENCE * 8 * _WORD_BYTES * words.shape[1]
        query, entry, different_bits = query[near], entry[near], different_bits[near]
        _, once = np.unique(query * self._count + entry, return_index=True)
        return query[once], entry[once], different_bits[once]


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
    """Return the array with uninitialised room at its end."""
    larger = np.empty(shape, array.dtype)
    if array.size:
        larger[: len(array)] = array
    return larger
