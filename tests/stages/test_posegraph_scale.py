"""Pose graphs beyond float64: jumps of thousands of kilometres beside sigmas of micrometres."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.bounds import SIGMA_METRES, SIGMA_RADIANS
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link
from slamcli.stages import posegraph
from slamcli.stages.posegraph import HeadingReading, PositionReading, SensorReadings

COUNT = 24
FARTHEST_METRES = 1e7
STEP_SIGMAS = (4e-5, 4e-5, 1e-4)


def step(a: int, rng: np.random.Generator) -> Link:
    motion = Pose2(0.02, float(rng.normal(0, 1e-3)), float(rng.normal(0, 0.01)))
    return Link(a, a + 1, motion, np.diag(np.square(STEP_SIGMAS)), 50, 1.0, "step")


def jump(a: int, rng: np.random.Generator) -> Link:
    """Return odometry as it reads after a jump of its numbers."""
    x, y = 10.0 ** rng.uniform(3, math.log10(FARTHEST_METRES), 2)
    sigma = math.hypot(x, y) / 16_000.0
    covariance = np.diag(np.square([sigma, sigma, sigma / 4.0]))
    motion = Pose2(float(x), float(y), float(rng.uniform(-3, 3)))
    return Link(a, a + 1, motion, covariance, 0, math.nan, "odometry")


def graph(seed: int) -> tuple[dict[int, Pose2], list[Link], SensorReadings]:
    """Return steps with a few jumps between them, and readings that agree with nothing."""
    rng = np.random.default_rng(seed)
    links = [jump(a, rng) if rng.random() < 0.2 else step(a, rng) for a in range(COUNT - 1)]
    poses = {0: Pose2()}
    for link in links:
        poses[link.b] = poses[link.a] @ link.a_from_b
    headings = [
        HeadingReading(frame, Pose2(), float(rng.uniform(-3, 3)), SIGMA_RADIANS.low, 1.0)
        for frame in rng.choice(COUNT, rng.integers(4), replace=False).tolist()
    ]
    positions = [
        PositionReading(
            frame,
            Pose2(),
            *rng.uniform(-FARTHEST_METRES, FARTHEST_METRES, 2).tolist(),
            float(rng.choice([SIGMA_METRES.low, 1.0])),
            1.0,
        )
        for frame in rng.choice(COUNT, rng.integers(4), replace=False).tolist()
    ]
    lever_arm = None if seed % 2 else (0.0, 0.0)
    return poses, links, SensorReadings(headings, positions, lever_arm, None)


@pytest.mark.parametrize("seed", range(8))
def test_a_graph_beyond_float64_has_finite_numbers_and_keeps_its_steps(seed: int) -> None:
    poses, links, readings = graph(seed)
    solution = posegraph.solve(poses, links, readings)
    for covariance in solution.covariances.values():
        assert np.isfinite(covariance).all()
        assert (np.diag(covariance) > 0.0).all()
    for link in links:
        off = link.a_from_b.inverse() @ solution.poses[link.a].inverse() @ solution.poses[link.b]
        assert np.isfinite([off.x, off.y, off.theta]).all()
        if link.kind == "step":
            # A float64 of ten thousand kilometres is exact to two nanometres.
            assert math.hypot(off.x, off.y) < 1e-4
            assert abs(off.theta) < 1e-3
