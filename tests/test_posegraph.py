"""Links weighed against one another, in cases whose answer is known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.geometry import Pose2
from slamcli.core.records import Link
from slamcli.stages import posegraph


def link(a: int, b: int, pose: Pose2, sigma: float = 0.01) -> Link:
    return Link(a, b, pose, np.diag([sigma, sigma, sigma]) ** 2, 30, 0.9, "step")


def test_two_opinions_meet_in_proportion_to_their_trust() -> None:
    links = [link(0, 1, Pose2(1.0), sigma=0.01), link(0, 1, Pose2(1.03), sigma=0.02)]
    solution = posegraph.solve({0: Pose2(), 1: Pose2(1.0)}, links)
    assert solution.poses[1].x == pytest.approx(1.006, abs=1e-6)
    variance = 1 / (1 / 0.01**2 + 1 / 0.02**2)
    assert solution.covariances[1][0, 0] == pytest.approx(variance, rel=1e-3)


def test_a_closed_square_spreads_its_error() -> None:
    side = Pose2(1.0, 0.0, math.pi / 2)
    links = [link(i, i + 1, side) for i in range(3)] + [link(3, 0, Pose2(1.04, 0.0, math.pi / 2))]
    initial = {0: Pose2()}
    for index in range(3):
        initial[index + 1] = initial[index] @ side
    poses = posegraph.solve(initial, links).poses
    errors = [(poses[i].inverse() @ poses[(i + 1) % 4]).x - 1.0 for i in range(4)]
    assert max(abs(error) for error in errors) < 0.035
    assert (poses[0].x, poses[0].y, poses[0].theta) == pytest.approx((0, 0, 0), abs=1e-6)


def test_components_are_what_links_connect() -> None:
    links = [link(4, 2, Pose2()), link(0, 1, Pose2()), link(5, 4, Pose2())]
    assert posegraph.components([0, 1, 2, 3, 4, 5], links) == [[0, 1], [2, 4, 5], [3]]


def test_covariance_is_carried_along_a_lever() -> None:
    # A heading sigma of 0.1 rad at a, 2 m ahead: 0.2 m sideways at b.
    carried = posegraph.compose_covariance(np.diag([0.0, 0.0, 0.01]), Pose2(2.0), np.zeros((3, 3)))
    assert math.sqrt(carried[1, 1]) == pytest.approx(0.2)
    assert carried[0, 0] == pytest.approx(0.0, abs=1e-12)
    random = np.random.default_rng(0)
    a_from_b = Pose2(0.4, -0.7, 0.9)
    root = 0.01 * random.normal(size=(3, 3))
    covariance = root @ root.T
    samples = random.multivariate_normal(np.zeros(3), covariance, size=20_000)
    ends = [a_from_b.inverse() @ Pose2(*sample) @ a_from_b for sample in samples]
    measured = np.cov(np.array([(p.x, p.y, p.theta) for p in ends]).T)
    np.testing.assert_allclose(
        measured,
        posegraph.compose_covariance(covariance, a_from_b, np.zeros((3, 3))),
        atol=0.05 * np.abs(measured).max(),
    )
