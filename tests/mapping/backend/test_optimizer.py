"""Batch optimisation: components, initial poses and what a solution does to the estimates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate
from slamcli.core.telemetry import OdometryReading
from slamcli.mapping.backend.optimizer import BatchOptimizer
from slamcli.mapping.backend.sensors import Sensors


def estimate(index: int, status: str = "tracked") -> PoseEstimate:
    """Poses far from the links': the optimiser must not start from them."""
    pose = None if status == "lost" else Pose2(100.0 * index, 7.0, 2.0)
    return PoseEstimate(
        index,
        str(index),
        float(index),
        pose,
        status,
        "why",
        5,
        np.eye(3),  # type: ignore[arg-type]
    )


def link(a: int, b: int, pose: Pose2, kind: str = "step", sigma: float = 0.01) -> Link:
    return Link(a, b, pose, sigma**2 * np.eye(3), 30, 0.9, kind)  # type: ignore[arg-type]


def by_odometry(count: int, step: Pose2) -> Sensors:
    sensors, pose = Sensors(), Pose2()
    for index in range(count):
        sensors.odometry(OdometryReading(float(index), pose))
        pose = pose @ step
    return sensors


def test_components_are_what_links_connect_from_their_first_placed_frame_on() -> None:
    estimates = [estimate(0, "lost"), *(estimate(index) for index in range(1, 6))]
    links = [link(1, 2, Pose2(1.0)), link(4, 5, Pose2(3.0))]
    # Odometry connects frames 0 and 1.
    found = BatchOptimizer(estimates, links, by_odometry(2, Pose2(0.5))).components()
    assert [sorted(component) for component in found] == [[1, 2], [3], [4, 5]]
    assert found[0] == {1: Pose2(), 2: Pose2(1.0)}


def test_odometry_connects_frames_without_links() -> None:
    estimates = [estimate(0), estimate(1, "lost"), estimate(2)]
    found = BatchOptimizer(estimates, [], by_odometry(3, Pose2(0.5))).components()
    assert [sorted(component) for component in found] == [[0, 1, 2]]
    assert found[0][2].x == pytest.approx(1.0)


def test_initial_poses_follow_steps_before_odometry_before_loops() -> None:
    """Loops alone may be false: a false one listed first does not enter the initial poses."""
    estimates = [estimate(index) for index in range(4)]
    links = [
        link(0, 3, Pose2(50.0), "loop"),
        link(0, 1, Pose2(1.0)),
        link(1, 2, Pose2(0.0, 1.0)),
    ]
    sensors = by_odometry(4, Pose2(0.7))
    initial = BatchOptimizer(estimates, links, sensors).components()[0]
    assert initial[2] == Pose2(1.0, 1.0)
    assert initial[3].x == pytest.approx(1.7)
    assert initial[3].y == pytest.approx(1.0)


def test_a_solution_places_frames_by_what_they_show_and_predicts_the_others() -> None:
    estimates = [estimate(0), estimate(1, "lost"), estimate(2), estimate(3, "lost")]
    links = [link(0, 2, Pose2(1.0)), link(0, 1, Pose2(0.5), "partial"), link(0, 3, Pose2(1.5))]
    optimizer = BatchOptimizer(estimates, links, by_odometry(4, Pose2(0.5)))
    update = optimizer.solve(optimizer.components()[0], 2)
    assert [e.index for e in update.estimates] == [0, 1, 2, 3]
    assert [e.status for e in update.estimates] == ["tracked", "predicted", "tracked", "tracked"]
    # A remark of a tracked frame stays; the reason for which a frame was lost does not.
    assert [e.reason for e in update.estimates] == ["why", "why", "why", ""]
    assert {e.fragment for e in update.estimates} == {update.fragment} == {2}
    assert update.links == (0, 1, 2)
    poses = [e.map_from_robot for e in update.estimates]
    assert all(pose is not None for pose in poses)
    assert [pose.x for pose in poses if pose] == pytest.approx([0.0, 0.5, 1.0, 1.5], abs=1e-6)


def test_a_switched_off_link_is_reported_and_does_not_place_its_frames() -> None:
    estimates = [estimate(index) for index in range(4)]
    steps = [link(index, index + 1, Pose2(1.0)) for index in range(3)]
    more = [link(index, index + 2, Pose2(2.0)) for index in range(2)]
    links = [link(0, 3, Pose2(9.0), "loop"), *steps, *more, link(0, 3, Pose2(3.0), "loop")]
    optimizer = BatchOptimizer(estimates, links, Sensors())
    update = optimizer.solve(optimizer.components()[0], 0)
    assert update.switched_off == {0}
    assert update.estimates[3].map_from_robot is not None
    assert update.estimates[3].map_from_robot.x == pytest.approx(3.0, abs=1e-6)


def test_fixed_frames_stay_and_covariances_are_conditional_on_them() -> None:
    estimates = [estimate(index) for index in range(3)]
    links = [link(0, 1, Pose2(1.0)), link(1, 2, Pose2(1.0))]
    optimizer = BatchOptimizer(estimates, links, Sensors())
    initial = {0: Pose2(), 1: Pose2(1.2), 2: Pose2(2.0)}
    solution = optimizer.optimize(initial, {1}).solution
    assert solution.poses[1].x == pytest.approx(1.2, abs=1e-7)
    assert solution.poses[0].x == pytest.approx(0.2, abs=1e-6)
    assert solution.poses[2].x == pytest.approx(2.2, abs=1e-6)
    assert math.sqrt(solution.covariances[1][0, 0]) < 1e-5
    assert math.sqrt(solution.covariances[2][0, 0]) == pytest.approx(0.01, rel=1e-3)
