"""Place recognition, in worlds of known landmarks."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Features
from slamcli.stages import place_index
from slamcli.stages.place_index import PlaceIndex

SIDE = 1.0


class Landmarks:
    """Points with descriptors on a floor; a view shows those of a square, noise in all of it."""

    def __init__(self, count: int, seed: int, kind: str = "hamming") -> None:
        generator = np.random.default_rng(seed)
        self.kind = kind
        self.points = generator.uniform(-2.0, 2.0, (count, 2))
        if kind == "hamming":
            self.descriptors = generator.integers(0, 256, (count, 32), dtype=np.uint8)
        else:
            self.descriptors = generator.gamma(1.0, 30.0, (count, 128)).astype(np.float32)

    def look(self, map_from_robot: Pose2, seed: int) -> Features:
        generator = np.random.default_rng(seed)
        points = map_from_robot.inverse().apply(self.points)
        seen = np.flatnonzero(np.abs(points).max(axis=1) < SIDE / 2)
        seen = seen[generator.random(len(seen)) < 0.7]
        points = points[seen] + generator.normal(0.0, 0.001, (len(seen), 2))
        descriptors = self.descriptors[seen]
        if self.kind == "hamming":
            flipped = np.packbits(generator.random((len(seen), 256)) < 0.12, axis=1)
            descriptors = descriptors ^ flipped
        else:
            descriptors = descriptors + generator.normal(0.0, 5.0, descriptors.shape)
            descriptors = descriptors.astype(np.float32)
        return Features(
            points.astype(np.float32),
            descriptors,
            generator.random(len(seen)).astype(np.float32),
            np.full((len(seen), 2), 0.001, np.float32),
            np.full(len(seen), 0.03, np.float32),
            np.full(len(seen), np.nan, np.float32),
            "hamming" if self.kind == "hamming" else "l2",
        )


@pytest.mark.parametrize("kind", ["hamming", "l2"])
def test_a_place_is_recognised_with_its_motion(kind: str) -> None:
    world = Landmarks(4000, 1, kind)
    index = PlaceIndex()
    poses = [Pose2(0.25 * n - 1.0, 0.2 * n - 0.8, 0.4 * n) for n in range(8)]
    for number, pose in enumerate(poses):
        index.add(100 + number, world.look(pose, number))
    now = poses[5] @ Pose2(0.1, -0.15, 2.8)
    places = index.query(world.look(now, 50))
    assert places[0].votes >= 8
    for place in places:
        error = (poses[place.keyframe - 100].inverse() @ now).inverse() @ place.keyframe_from_now
        assert error.translation_length < 0.003
        assert abs(math.degrees(error.theta)) < 0.5
    nearest = places[0].keyframe
    fewer = index.query(world.look(now, 50), frozenset({nearest}))
    assert nearest not in {place.keyframe for place in fewer}


def test_floor_never_seen_is_not_recognised() -> None:
    index = PlaceIndex()
    known, unknown = Landmarks(4000, 1), Landmarks(4000, 2)
    for number in range(20):
        index.add(number, known.look(Pose2(0.1 * number - 1.0), number))
    for number in range(20):
        assert not index.query(unknown.look(Pose2(0.1 * number - 1.0, 0.3), number))


def test_the_same_points_in_another_order_on_the_floor_are_no_place() -> None:
    world = Landmarks(4000, 1)
    seen = world.look(Pose2(), 0)
    index = PlaceIndex()
    index.add(0, seen)
    shuffled = np.random.default_rng(0).permutation(seen.points)
    elsewhere = replace(seen, points=shuffled)
    assert index.query(seen)[0].votes > 50
    assert not index.query(elsewhere)


def test_a_look_up_reads_no_more_of_a_large_map_than_of_a_small_one() -> None:
    """A bucket that all floors share, as that of plain paint is, is read only so deep."""
    index = PlaceIndex()
    same = Features(
        np.random.default_rng(0).uniform(-1, 1, (200, 2)).astype(np.float32),
        np.zeros((200, 32), np.uint8),
        np.ones(200, np.float32),
        np.full((200, 2), 0.001, np.float32),
        np.full(200, 0.03, np.float32),
        np.full(200, np.nan, np.float32),
    )
    for number in range(50):
        index.add(number, same)
    query, _, _ = index._look_up(np.zeros((1, 4), np.uint64))
    assert len(query) <= place_index._MAX_READ * place_index._TABLES < 200


def test_a_query_is_deterministic() -> None:
    world = Landmarks(4000, 1)
    answers = []
    for _ in range(2):
        index = PlaceIndex()
        for number in range(10):
            index.add(number, world.look(Pose2(0.1 * number), number))
        answers.append(index.query(world.look(Pose2(0.45, 0.1, 1.0), 99)))
    assert answers[0] == answers[1]


def test_an_index_goes_on_from_a_kept_state_as_if_it_had_not_been_cut_off() -> None:
    world = Landmarks(4000, 1)
    looks = [world.look(Pose2(0.05 * number), number % 3) for number in range(40)]
    whole, kept = PlaceIndex(), PlaceIndex()
    for number, seen in enumerate(looks):
        whole.add(number, seen)
        kept.add(number, seen)
        if number == 24:
            state = pickle.dumps(kept)
            assert len(state) < 2e6
            kept = pickle.loads(state)
    np.testing.assert_array_equal(kept._heads, whole._heads)
    np.testing.assert_array_equal(kept._next[: kept._count], whole._next[: whole._count])
    now = world.look(Pose2(0.45, 0.1, 1.0), 99)
    assert kept.query(now) == whole.query(now) != []
    assert pickle.loads(pickle.dumps(PlaceIndex())).query(now) == []
