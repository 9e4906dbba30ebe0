"""Loop closure: loops closed, a carried robot relocalised, and no false link accepted."""

from __future__ import annotations

import math
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from worlds import make_photographer, take

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.mapping.backend.pose_graph import PoseGraph
from slamcli.mapping.keyframes import KeyframeCache, encode_keyframe
from slamcli.simulation import photograph
from slamcli.stages import covisibility, dense

LOOP_FRAMES = 26
# Round a circle a little more than once, so that the end sees the beginning.
CIRCLE = [
    Pose2(0.25 * math.sin(a), 0.25 * (1.0 - math.cos(a)), a)
    for a in np.linspace(0.0, 1.1 * math.tau, LOOP_FRAMES)
]


@pytest.fixture(scope="module")
def photographer() -> photograph.Photographer:
    return make_photographer()


def drive(
    photographer: photograph.Photographer, poses: list[Pose2], options: slamcli.MapperOptions
) -> slamcli.Mapper:
    mapper = slamcli.Mapper(photographer.calibration, options)
    for index, pose in enumerate(poses):
        mapper.update(take(photographer, pose, index))
    return mapper


def worst_metres(estimates: list[slamcli.PoseEstimate], truth: list[Pose2]) -> float:
    worst = 0.0
    for estimate in estimates:
        assert estimate.map_from_robot is not None, estimate.reason
        error = truth[estimate.index].inverse() @ estimate.map_from_robot
        worst = max(worst, error.translation_length)
    return worst


@pytest.fixture(scope="module")
def circle(photographer: photograph.Photographer) -> slamcli.Mapper:
    return drive(photographer, CIRCLE, slamcli.MapperOptions())


def test_threads_find_the_loops_that_one_does(circle: slamcli.Mapper) -> None:
    kept = pickle.dumps(circle)
    alone, together = pickle.loads(kept), pickle.loads(kept)
    before = len(circle.links)
    with ThreadPoolExecutor(3) as executor:
        estimates = together.finish(executor.map)
    for one, other in zip(alone.finish(), estimates, strict=True):
        assert one.map_from_robot == other.map_from_robot
    links = [(link.a, link.b, link.a_from_b) for link in alone.links]
    assert links == [(link.a, link.b, link.a_from_b) for link in together.links]
    assert len(links) > before


def test_a_loop_is_closed_by_true_links_alone(circle: slamcli.Mapper) -> None:
    # Some as the robot comes round, and all that the poses predict at the end.
    assert [link for link in circle.links if link.kind == "loop"]
    assert worst_metres(circle.finish(), CIRCLE) < 0.001
    loops = [link for link in circle.links if link.kind == "loop"]
    assert any(link.b - link.a > LOOP_FRAMES * 3 // 4 for link in loops)
    for link in loops:
        error = (CIRCLE[link.a].inverse() @ CIRCLE[link.b]).inverse() @ link.a_from_b
        assert error.translation_length < 0.001
    before = len(circle.links)
    circle.finish()
    assert len(circle.links) == before


def test_a_carried_robot_is_relocalised_and_never_placed_while_away(
    photographer: photograph.Photographer,
) -> None:
    known = [Pose2(0.05 * n, 0.0, 0.0) for n in range(8)]
    away = [Pose2(8.0 + 0.05 * n, 5.0, 1.0) for n in range(3)]
    # Back on the first lane, crossed at another heading.
    start = Pose2(0.42, -0.2, 1.9)
    back = [start @ Pose2(0.04 * n) for n in range(3)]
    truth = [*known, *away, *back]
    mapper = slamcli.Mapper(photographer.calibration)
    streamed = [mapper.update(take(photographer, pose, n)) for n, pose in enumerate(truth)]
    assert [estimate.fragment for estimate in streamed[: len(known)]] == [0] * len(known)
    assert all(estimate.fragment != 0 for estimate in streamed[len(known) : -len(back)])
    relocalised = [e for e in streamed[-len(back) :] if e.fragment == 0]
    assert relocalised
    for estimate in relocalised:
        assert estimate.map_from_robot is not None
        error = truth[estimate.index].inverse() @ estimate.map_from_robot
        assert error.translation_length < 0.002
        assert abs(math.degrees(error.theta)) < 0.3
    final = {estimate.index: estimate for estimate in mapper.finish()}
    assert all(final[n].fragment != 0 for n in range(len(known), len(known) + len(away)))


def test_without_loops_a_drive_is_a_chain(photographer: photograph.Photographer) -> None:
    poses = [CIRCLE[0], CIRCLE[1], Pose2(5.0), Pose2(5.05), CIRCLE[0] @ Pose2(0.0, 0.01, 0.1)]
    mapper = drive(photographer, poses[:2], slamcli.MapperOptions(loops=False))
    mapper.finish()
    assert {link.kind for link in mapper.links} == {"step"}


def test_a_motion_that_the_poses_contradict_is_rejected(circle: slamcli.Mapper) -> None:
    """The pixels say where the frames are; poses that are certain of another place contradict."""
    closer = circle._loop_closer
    honest = list(closer.find_loops(_graph_of(circle, CIRCLE)))
    assert honest
    shifted = [pose if n < 13 else Pose2(0.3) @ pose for n, pose in enumerate(CIRCLE)]
    closer._failed.clear()
    graph = _graph_of(circle, shifted)
    firm = [link for link in closer.find_loops(graph) if (link.a < 13) != (link.b < 13)]
    assert not firm


def test_a_guess_that_the_poses_contradict_is_not_registered(
    circle: slamcli.Mapper, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What looks alike by its descriptors is 2 m away, by poses that are certain to 0.1 mm."""
    closer, registered = circle._loop_closer, []
    monkeypatch.setattr(
        closer._relocalizer, "register_reliably", lambda a, b, *_: registered.append((a, b.index))
    )
    shifted = [pose if n < 13 else Pose2(2.0) @ pose for n, pose in enumerate(CIRCLE)]
    alike = [
        (one.keyframe, b)
        for b, candidates in closer._alike.items()
        for one in candidates
        if (one.keyframe < 13) != (b < 13)
    ]
    assert alike
    closer._failed.clear()
    closer.find_loops(_graph_of(circle, shifted))
    assert not registered


def _graph_of(mapper: slamcli.Mapper, poses: list[Pose2]) -> PoseGraph:
    """The mapper's graph without loops, with certain poses."""
    graph = PoseGraph()
    graph.add_links(link for link in mapper.links if link.kind != "loop")
    for estimate in mapper.estimates:
        covariance = np.diag([1e-8, 1e-8, 1e-8])
        pose = poses[estimate.index]
        graph.set_estimate(replace(estimate, map_from_robot=pose, covariance=covariance))
    return graph


def test_a_kept_keyframe_compares_like_the_frame_itself(
    photographer: photograph.Photographer,
) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    first, second = (
        mapper.prepare(Frame(n, str(n), None, take(photographer, Pose2(0.05 * n), n)))
        for n in range(2)
    )
    again = KeyframeCache(mapper.grid).decode(encode_keyframe(first))
    size = len(encode_keyframe(first).image) + len(encode_keyframe(first).mask)
    assert size < sum(level.detail.nbytes for level in first.levels) / 10
    true, kept = (dense.agreement(p.levels[0], second.levels[0], np.eye(3)) for p in (first, again))
    assert kept.overlap == true.overlap
    assert kept.correlation == pytest.approx(true.correlation, abs=0.02)


def test_a_kept_keyframe_has_the_same_sift_descriptors(
    photographer: photograph.Photographer,
) -> None:
    options = slamcli.MapperOptions(features=slamcli.FeatureOptions(method="sift", count=200))
    mapper = slamcli.Mapper(photographer.calibration, options)
    prepared = mapper.prepare(Frame(0, "0", None, take(photographer, Pose2(), 0)))
    kept = encode_keyframe(prepared)
    again = KeyframeCache(mapper.grid).decode(kept)
    assert kept.features.descriptors.dtype == np.uint8
    assert prepared.features is not None
    assert again.features is not None
    assert again.features.descriptors.dtype == np.float32
    np.testing.assert_array_equal(again.features.descriptors, prepared.features.descriptors)


def test_overlap_of_footprints_is_that_of_the_views(photographer: photograph.Photographer) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    seen = mapper.prepare(Frame(0, "0", None, take(photographer, Pose2(), 0))).levels[0]
    footprint = covisibility.Footprint(photographer.calibration)
    for pose in (Pose2(), Pose2(0.1), Pose2(0.05, 0.1, 0.4), Pose2(0.6, 0.0, 3.1), Pose2(3.0)):
        share = footprint.overlaps(np.array([[pose.x, pose.y, pose.theta]]))[0]
        assert share == pytest.approx(dense.overlap(seen, seen, pose), abs=0.06)
