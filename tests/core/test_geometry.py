from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.geometry import Grid, Pose2, apply_homography, path_length, wrap_angle


def test_a_product_of_poses_walks_one_after_the_other() -> None:
    quarter_turn = Pose2(1.0, 0.0, math.pi / 2)
    walked = quarter_turn @ Pose2(2.0, 0.0, 0.0)
    assert (walked.x, walked.y) == pytest.approx((1.0, 2.0))
    np.testing.assert_allclose(
        walked.matrix, quarter_turn.matrix @ Pose2(2.0, 0.0, 0.0).matrix, atol=1e-15
    )


def test_an_inverse_undoes() -> None:
    pose = Pose2(0.3, -1.2, 2.5)
    back = pose @ pose.inverse()
    assert (back.x, back.y, back.theta) == pytest.approx((0.0, 0.0, 0.0), abs=1e-15)
    np.testing.assert_allclose(pose.inverse().apply(pose.apply([[4.0, 5.0]])), [[4.0, 5.0]])


def test_angles_are_wrapped_into_one_turn() -> None:
    assert wrap_angle(3 * math.pi / 2) == pytest.approx(-math.pi / 2)
    assert Pose2(0, 0, math.tau + 0.1).theta == pytest.approx(0.1)


def test_a_homography_takes_points_in_any_shape_and_to_infinity() -> None:
    homography = np.array([[2.0, 0.5, 1.0], [0.0, 1.0, -3.0], [0.5, 0.0, 1.0]])
    points = np.arange(24.0).reshape(3, 4, 2)
    mapped = apply_homography(homography, points)
    for place, (x, y) in zip(mapped.reshape(-1, 2), points.reshape(-1, 2), strict=True):
        scale = 0.5 * x + 1.0
        np.testing.assert_allclose(place, [(2 * x + 0.5 * y + 1) / scale, (y - 3) / scale])
    assert apply_homography(homography, (4.0, 2.0)).shape == (2,)
    assert apply_homography(homography, np.empty((0, 2))).shape == (0, 2)
    assert not np.isfinite(apply_homography(homography, [-2.0, 7.0])).any()


def test_a_grid_has_its_pixels_centres_half_a_pixel_in() -> None:
    grid = Grid(x_min=-1.0, y_max=2.0, metres_per_pixel=0.5, width=4, height=6)
    centre = apply_homography(grid.metres_from_pixel, [[0.0, 0.0], [3.0, 5.0]])
    np.testing.assert_allclose(centre, [[-0.75, 1.75], [0.75, -0.75]])
    np.testing.assert_allclose(
        grid.pixel_from_metres @ grid.metres_from_pixel, np.eye(3), atol=1e-12
    )
    assert (grid.x_max, grid.y_min) == (1.0, -1.0)


def test_a_grid_covers_its_points_and_starts_on_whole_pixels() -> None:
    grid = Grid.covering([[0.13, -0.4], [1.01, 0.77]], 0.1)
    assert grid.x_min == pytest.approx(0.1)
    assert grid.y_max == pytest.approx(0.8)
    assert (grid.width, grid.height) == (10, 12)


def test_a_window_keeps_its_place() -> None:
    grid = Grid(0.0, 1.0, 0.1, 10, 10)
    window = grid.window(3, 4, 2, 2)
    inside = apply_homography(window.metres_from_pixel, [[0.0, 0.0]])
    np.testing.assert_allclose(inside, apply_homography(grid.metres_from_pixel, [[3.0, 4.0]]))


def test_path_length_adds_the_steps() -> None:
    assert path_length([Pose2(), Pose2(3.0, 4.0), Pose2(3.0, 5.0)]) == pytest.approx(6.0)
    assert path_length([Pose2()]) == 0.0
