"""The camera over the floor, against hand-worked geometry."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from slamcli.core.camera.calibration import Calibration, DistortionModel, top_down_calibration
from slamcli.core.camera.footprint import (
    FAR_TO_NEAR_SAMPLING_RATIO,
    choose_max_range,
    default_metres_per_pixel,
    footprint,
    footprint_hull,
    seen_floor,
)
from slamcli.core.camera.lens import distort_points, undistort_points, undistorted_bounds
from slamcli.core.camera.mounting import compose_robot_from_image, image_from_robot_homography
from slamcli.core.camera.projection import project_floor, sampling_map
from slamcli.core.camera.resolution import floor_sampling, range_sigma, resolution_image
from slamcli.core.errors import CalibrationError
from slamcli.core.geometry import Pose2, apply_homography

CAMERA_MATRIX = np.array([[600.0, 0.0, 319.5], [0.0, 600.0, 239.5], [0.0, 0.0, 1.0]])


def calibration_of(
    pitch_degrees: float = 45.0,
    roll_degrees: float = 0.0,
    distortion: tuple[float, ...] = (0.0,) * 5,
    model: DistortionModel = "plumb_bob",
    max_range_metres: float = 2.0,
) -> Calibration:
    pitch, roll = math.radians(pitch_degrees), math.radians(roll_degrees)
    return Calibration(
        camera_matrix=CAMERA_MATRIX,
        distortion=np.array(distortion),
        distortion_model=model,
        image_size=(640, 480),
        robot_from_image=compose_robot_from_image(CAMERA_MATRIX, 0.5, pitch, roll),
        height_metres=0.5,
        pitch_radians=pitch,
        roll_radians=roll,
        max_range_metres=max_range_metres,
    )


def test_the_image_centre_sees_the_floor_where_the_axis_meets_it() -> None:
    calibration = calibration_of(pitch_degrees=45.0)
    floor = apply_homography(calibration.robot_from_image, [[319.5, 239.5]])
    np.testing.assert_allclose(floor, [[0.5, 0.0]], atol=1e-12)


def test_left_in_the_picture_is_left_of_the_robot_and_below_is_nearer() -> None:
    floor = apply_homography(calibration_of().robot_from_image, [[100.0, 239.5], [319.5, 400.0]])
    assert floor[0, 1] > 0.1
    assert floor[1, 0] < 0.4


def test_positive_roll_lowers_the_right_side() -> None:
    # With its right side lowered the camera sees nearer floor at the right end of its middle row.
    rolled = calibration_of(roll_degrees=5.0)
    left, right = apply_homography(rolled.robot_from_image, [[20.0, 239.5], [620.0, 239.5]])
    assert math.hypot(*right) < math.hypot(*left)


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ((-0.25, 0.07, 0.001, -0.002, 0.0), "plumb_bob"),
        ((0.1, -0.05, 0.0005, 0.0005, 0.01, 0.02, 0.0, 0.0), "rational_polynomial"),
        ((-0.03, 0.01, -0.002, 0.0003), "equidistant"),
    ],
)
def test_distortion_is_undone(distortion: tuple[float, ...], model: DistortionModel) -> None:
    calibration = calibration_of(distortion=distortion, model=model)
    pixels = np.array([[5.0, 5.0], [320.0, 240.0], [600.0, 100.0], [50.0, 470.0]])
    undistorted = undistort_points(calibration, pixels)
    assert np.abs(undistorted - pixels).max() > 1.0
    np.testing.assert_allclose(distort_points(calibration, undistorted), pixels, atol=1e-4)


def test_sampling_is_what_one_pixel_covers() -> None:
    calibration = calibration_of()
    pixels = np.array([[320.0, 300.0], [320.0, 301.0], [321.0, 300.0]])
    floor = apply_homography(calibration.robot_from_image, pixels)
    along, across = floor_sampling(calibration, floor[:1])[0]
    assert along == pytest.approx(np.linalg.norm(floor[1] - floor[0]), rel=0.01)
    assert across == pytest.approx(np.linalg.norm(floor[2] - floor[0]), rel=0.01)


def test_a_raster_is_projected_like_its_points_and_never_from_behind() -> None:
    calibration = calibration_of(
        pitch_degrees=12.0, roll_degrees=3.0, distortion=(-0.3, 0.1, 0.0, 0.0, 0.0)
    )
    grid = footprint(calibration, 0.02).window(-60, -20, 160, 140)
    robot_from_grid = Pose2(0.1, -0.05, 0.2)
    pixels_per_metre = resolution_image(calibration)
    mapping = sampling_map(calibration, pixels_per_metre, grid, robot_from_grid)
    columns, rows = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    inside = np.column_stack([columns.ravel(), rows.ravel()])
    floor = robot_from_grid.apply(apply_homography(grid.metres_from_pixel, inside))
    pixels, seen = project_floor(calibration, floor)
    drawn = mapping.pixels_per_metre.ravel() > 0
    # Interpolation may count a pixel in that lies on the very border.
    assert np.count_nonzero(drawn != seen) < 0.02 * len(seen)
    assert 0.1 < seen.mean() < 0.9
    both = drawn & seen
    mapped = np.column_stack([mapping.columns.ravel(), mapping.rows.ravel()])
    np.testing.assert_allclose(mapped[both], pixels[both], atol=1e-3)
    assert floor[drawn, 0].min() > 0
    sampling = np.sqrt(np.prod(floor_sampling(calibration, floor[both]), axis=1))
    ratio = mapping.pixels_per_metre.ravel()[both] * sampling
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)


def test_the_footprint_reaches_from_the_near_edge_to_the_far_limit() -> None:
    calibration = calibration_of(pitch_degrees=20.0, max_range_metres=1.5)
    grid = footprint(calibration, 0.01)
    near = 0.5 / math.tan(math.radians(20.0) + math.atan2(479 - 239.5, 600))
    assert grid.x_min == pytest.approx(near, abs=0.02)
    assert grid.x_max == pytest.approx(1.5, abs=0.011)


def test_the_far_limit_is_where_a_pixel_covers_too_much() -> None:
    level = image_from_robot_homography(CAMERA_MATRIX, 0.5, math.radians(5.0), 0.0)
    far = choose_max_range(CAMERA_MATRIX, level, (640, 480))
    calibration = calibration_of(pitch_degrees=5.0, max_range_metres=far)
    near = footprint(calibration, 0.001).x_min
    along = floor_sampling(calibration, [[near, 0.0], [far, 0.0]])[:, 0]
    assert along[1] / along[0] == pytest.approx(FAR_TO_NEAR_SAMPLING_RATIO, rel=0.15)


def test_a_camera_that_sees_no_floor_says_so() -> None:
    with pytest.raises(CalibrationError, match="sees no floor"):
        footprint(calibration_of(pitch_degrees=-50.0), 0.01)


def test_top_down_frames_are_their_own_map() -> None:
    calibration = top_down_calibration((64, 48))
    grid = footprint(calibration, default_metres_per_pixel(calibration))
    assert (grid.width, grid.height, grid.metres_per_pixel) == (64, 48, 1.0)
    corner = apply_homography(calibration.robot_from_image, [[0.0, 0.0]])
    np.testing.assert_allclose(corner, [[-31.5, 23.5]])


def test_a_tilt_shifts_far_floor_as_range_sigma_says() -> None:
    tilt = 1e-4
    before, after = calibration_of(20.0), calibration_of(20.0 + math.degrees(tilt))
    pixel = project_floor(before, [[1.2, 0.1]])[0]
    moved = apply_homography(after.robot_from_image, pixel)[0]
    shift = math.hypot(1.2, 0.1) - math.hypot(*moved)
    assert shift == pytest.approx(range_sigma(before, [[1.2, 0.1]], tilt)[0], rel=0.01)


def test_what_follows_from_a_calibration_is_computed_once_and_cannot_be_changed() -> None:
    calibration = calibration_of(distortion=(-0.1, 0.0, 0.0, 0.0, 0.0))
    nearer = replace(calibration, max_range_metres=1.0)
    for facts in (
        lambda camera: camera.image_from_robot,
        undistorted_bounds,
        seen_floor,
        footprint_hull,
        resolution_image,
    ):
        found = facts(calibration)
        assert facts(calibration) is found
        assert facts(nearer) is not found
        with pytest.raises(ValueError, match="read-only"):
            found[0] = 0.0
    assert np.hypot(*footprint_hull(nearer).T).max() < 1.01
