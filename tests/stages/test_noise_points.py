"""Points that show only noise: what they would do to a refinement over a plain floor."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from slamcli.core.arrays import UInt8Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import PyramidLevel
from slamcli.stages import dense
from slamcli.stages.dense.noise_points import without_noise
from slamcli.stages.dense.photometric_residuals import WarpModel
from tests.floor_pictures import asphalt, look, square_grid, top_down

SIDE = 900
# A square far from the middle of the view, metres of one pixel each.
SQUARE = Pose2(190.0, 190.0, 0.3)
MOTION = Pose2(6.0, -4.0, 0.05)


def plain_floor() -> UInt8Array:
    """Return a dark floor with one white square on it."""
    floor = np.full((SIDE, SIDE), 40, np.uint8)
    corners = SQUARE.apply(25.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]))
    pixels = square_grid(SIDE).pixel_from_metres @ np.column_stack([corners, np.ones(4)]).T
    cv2.fillPoly(floor, [np.round(pixels[:2].T).astype(np.int32)], 230.0)
    return floor


def levels_of(floor: UInt8Array, pose: Pose2, seed: int) -> tuple[PyramidLevel, ...]:
    """Return the pyramid of a view from half of its resolution on, which has half the noise."""
    return dense.make_levels(look(floor, pose, noise=4.0, seed=seed))[1:]


@pytest.mark.parametrize("degrees", [-2.0, 2.0])
def test_a_turn_about_a_lone_square_is_refined_from_afar(degrees: float) -> None:
    floor = plain_floor()
    a, b = levels_of(floor, Pose2(), 0), levels_of(floor, MOTION, 1)
    about = MOTION.inverse() @ SQUARE
    start = MOTION @ about @ Pose2(0.0, 0.0, math.radians(degrees)) @ about.inverse()
    refined = dense.refine(a, b, start, top_down(), 0.0)
    assert refined is not None
    error = MOTION.inverse() @ refined.a_from_b
    assert abs(math.degrees(error.theta)) < 0.1
    sigma = math.sqrt(refined.covariance[2, 2])
    assert abs(error.theta) < 3.0 * sigma
    assert math.degrees(sigma) < 0.3


@pytest.mark.parametrize(("floor", "fewer"), [(plain_floor(), True), (asphalt(SIDE), False)])
def test_only_points_of_noise_are_left_out(floor: UInt8Array, *, fewer: bool) -> None:
    a, b = levels_of(floor, Pose2(), 0)[0], levels_of(floor, MOTION, 1)[0]
    model = WarpModel(top_down(), np.zeros(0), None)
    kept = without_noise(a, b, model, model.start(MOTION))
    assert (len(kept.points) < 0.2 * len(a.points)) == fewer
    assert fewer or kept is a
