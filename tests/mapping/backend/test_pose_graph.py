"""The pose graph as the one owner of its state, and the back end that changes it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate, PreparedFrame
from slamcli.core.telemetry import OdometryReading
from slamcli.mapping.backend.backend import Backend
from slamcli.mapping.backend.pose_graph import GraphUpdate, PoseGraph, most_certain, tracked
from slamcli.stages.posegraph import SensorOffsets

OFFSETS = SensorOffsets(0.0, 1.0, Pose2(), np.eye(3), (0.0, 0.0))


def frame(index: int) -> PreparedFrame:
    return PreparedFrame(index, str(index), float(index), None, None, "")


def link(a: int, b: int, pose: Pose2, sigma: float = 0.01, kind: str = "step") -> Link:
    return Link(a, b, pose, sigma**2 * np.eye(3), 30, 0.9, kind)  # type: ignore[arg-type]


def chain(count: int) -> PoseGraph:
    graph = PoseGraph()
    for index in range(count):
        graph.set_estimate(tracked(frame(index), Pose2(float(index)), 1e-4 * np.eye(3), 0))
        if index:
            graph.add_links([link(index - 1, index, Pose2(1.0))])
    return graph


def test_frames_are_kept_in_the_order_of_insertion_with_the_links_before_them() -> None:
    graph = PoseGraph()
    for index in (5, 2, 9):
        graph.set_estimate(tracked(frame(index), Pose2(), np.eye(3), 0))
        graph.add_links([link(index, index, Pose2())])
    graph.set_estimate(PoseEstimate(2, "2", None, None, "lost"))
    assert graph.order == [5, 2, 9]
    assert graph.links_before == [0, 1, 2]
    assert [e.index for e in graph.estimates] == [2, 5, 9]
    assert graph.next_index == 10
    assert not graph.is_placed(2)
    latest = graph.latest_placed
    assert latest is not None
    assert latest.index == 9


def test_the_latest_placed_frame_of_a_fragment_is_found_among_few() -> None:
    graph = chain(6)
    graph.set_estimate(PoseEstimate(3, "3", None, None, "lost"))
    graph.set_estimate(tracked(frame(2), Pose2(), np.eye(3), 1))
    assert graph.placed_before(6, 0, 6) == 5
    assert graph.placed_before(4, 0, 6) == 1
    assert graph.placed_before(4, 1, 6) == 2
    assert graph.placed_before(4, 0, 2) is None


def test_a_new_frame_is_placed_by_the_most_certain_of_its_links() -> None:
    graph = chain(2)
    uncertain, certain = link(1, 2, Pose2(5.0), 0.1), link(0, 2, Pose2(0.0, 2.0), 0.01)
    assert most_certain([uncertain, certain]) is certain
    predicted = graph.predict_pose(frame(2), [uncertain, certain])
    assert predicted.map_from_robot == Pose2(0.0, 2.0)
    assert predicted.covariance is not None
    # The heading sigma of frame 0, 0.01 rad, acts on a lever of 2 m; plus that of both positions.
    assert math.sqrt(predicted.covariance[0, 0]) == pytest.approx(math.sqrt(2e-4 + 4e-4))
    assert 2 not in graph, "a prediction does not change the graph"


def test_an_update_replaces_what_it_covers_and_nothing_else() -> None:
    graph = chain(4)
    estimate = tracked(frame(1), Pose2(9.0), np.eye(3), 0)
    graph.apply(GraphUpdate(0, (estimate,), (0, 1), frozenset({0}), OFFSETS, None))
    assert graph.switched_off == {0}
    assert graph.pose(1) == Pose2(9.0)
    assert graph.pose(2) == Pose2(2.0)
    assert graph.offsets == {0: OFFSETS}
    assert not graph.georeferences
    # Link 0 is outside the next update: it stays off. Link 1 is in it, and is switched off.
    graph.apply(GraphUpdate(3, (), (1, 2), frozenset({1}), OFFSETS, None))
    assert graph.switched_off == {0, 1}
    assert set(graph.offsets) == {0, 3}
    graph.apply(GraphUpdate(0, (), (0, 1, 2), frozenset(), OFFSETS, None))
    assert graph.switched_off == frozenset()
    graph.clear_solution()
    assert not graph.offsets
    assert graph.pose(1) == Pose2(9.0)


def test_a_link_to_another_fragment_joins_both_and_reports_what_moved() -> None:
    backend = Backend()
    backend.begin_fragment(frame(0))
    backend.place(frame(1), [link(0, 1, Pose2(1.0))])
    backend.begin_fragment(frame(2))
    backend.place(frame(3), [link(2, 3, Pose2(1.0))])
    assert [e.fragment for e in backend.graph.estimates] == [0, 0, 1, 1]
    backend.add_links(3, [link(1, 3, Pose2(0.0, 1.0), kind="loop")])
    assert [e.fragment for e in backend.graph.estimates] == [0] * 4
    assert backend.graph[3].revised == (0, 1, 2)
    apart = Pose2(1.0, 1.0).inverse() @ backend.graph.pose(3)
    assert apart.translation_length < 1e-6


def test_a_frame_that_shows_nothing_is_predicted_by_odometry_or_lost() -> None:
    backend = Backend()
    backend.begin_fragment(frame(0))
    assert backend.add_lost(frame(1), "shows nothing").status == "lost"
    for index in range(4):
        backend.sensors.odometry(OdometryReading(float(index), Pose2(0.5 * index)))
    predicted = backend.add_lost(frame(2), "shows nothing")
    assert predicted.status == "predicted"
    assert predicted.map_from_robot == Pose2(1.0)
    assert predicted.odom_from_robot == Pose2(1.0)
    assert backend.add_duplicate(frame(2), frame(3)).map_from_robot == Pose2(1.5)


def test_a_partial_link_belongs_to_its_own_frame() -> None:
    """A window that begins at that frame must contain it."""
    backend = Backend()
    backend.begin_fragment(frame(0))
    for index in range(2):
        backend.sensors.odometry(OdometryReading(float(index), Pose2(0.5 * index)))
    backend.add_lost(frame(1), "a line", link(0, 1, Pose2(0.5), kind="partial"))
    assert backend.graph.links_before[1] == 0
    assert [k.kind for k in backend.graph.links] == ["partial"]


def test_the_whole_solution_numbers_fragments_by_size_and_loses_single_frames() -> None:
    backend = Backend()
    backend.begin_fragment(frame(0))
    backend.begin_fragment(frame(1))
    backend.place(frame(2), [link(1, 2, Pose2(1.0))])
    backend.begin_fragment(frame(3))
    for index in (4, 5):
        backend.place(frame(index), [link(index - 1, index, Pose2(1.0))])
    backend.solve()
    assert [e.fragment for e in backend.graph.estimates] == [-1, 1, 1, 0, 0, 0]
    assert backend.graph[0].reason == "overlaps no other frame"
    assert backend.graph.pose(3).translation_length < 1e-6
    backend.solve([link(2, 3, Pose2(1.0), kind="loop")])
    assert [e.fragment for e in backend.graph.estimates] == [-1, 0, 0, 0, 0, 0]
    assert backend.graph.pose(5).x == pytest.approx(4.0, abs=1e-6)
