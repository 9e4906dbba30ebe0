"""The square is found by itself, to a fraction of a pixel, whatever lies on and around it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from square_photos import Photo, random_photo, render

from slamcli.core.camera.calibration import Intrinsics
from slamcli.core.errors import CalibrationError
from slamcli.core.light import Gamma, codes_of_light, light_of_gray, light_of_image
from slamcli.stages import calibrate
from slamcli.stages.square import Square, find_squares, refine_square


def plain_lens(size: tuple[int, int]) -> Intrinsics:
    return Intrinsics(np.diag([float(size[0]), size[0], 1.0]), np.zeros(5), "plumb_bob", size)


def find(
    image: np.ndarray, intrinsics: Intrinsics | None = None, gamma: Gamma = "srgb"
) -> tuple[Square, ...]:
    size = (image.shape[1], image.shape[0])
    how_square = partial(
        calibrate.squareness,
        image_size=size,
        intrinsics=intrinsics,
        tolerance_pixels=0.004 * size[0],
    )
    return find_squares(image, intrinsics or plain_lens(size), how_square, gamma)


def corner_errors(corners: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances in pixels, for the order of the true corners that fits best."""
    orders = [np.roll(turned, k, axis=0) for turned in (truth, truth[::-1]) for k in range(4)]
    errors = [np.linalg.norm(corners - order, axis=1) for order in orders]
    return min(errors, key=lambda error: float(error.max()))


def test_corners_of_a_clean_photo_are_good_to_a_twentieth_of_a_pixel() -> None:
    photo = Photo(yaw=17.0, noise=1.0)
    (square,) = find(render(photo))
    assert corner_errors(square.corners, photo.corners).max() < 0.05


def test_spots_of_a_light_floor_beside_a_dark_square_hardly_move_its_sides() -> None:
    # By weights alike to either side of the edges the corners are 0.09 px off.
    errors = []
    for seed in range(3):
        photo = Photo(seed=seed, yaw=17.0, blur=0.8, noise=1.0, texture=12.0)
        photo = replace(photo, square_level=40.0, floor_level=180.0)
        (square,) = find(render(photo))
        errors.append(corner_errors(square.corners, photo.corners))
    assert np.sqrt(np.mean(np.square(errors))) < 0.06


def test_a_side_along_the_pixel_rows_is_not_pulled_to_whole_pixels() -> None:
    # Straight ahead, the near and far sides run along rows: every profile has the same phase.
    errors = []
    for offset in np.arange(4) / 4 * 0.002:
        photo = Photo(yaw=0.0, roll=0.0, centre=(0.55 + offset, 0.0))
        (square,) = find(render(photo))
        errors.append(np.sort(square.corners[:, 1]) - np.sort(photo.corners[:, 1]))
    assert np.abs(errors).max() < 0.02


@pytest.mark.parametrize("seed", range(5))
def test_it_is_found_on_a_textured_floor_with_lines_marks_and_noise(seed: int) -> None:
    photo = random_photo(100 + seed, hard=True)
    square = find(render(photo))[0]
    assert corner_errors(square.corners, photo.corners).max() < 0.7


@pytest.mark.parametrize("white", [True, False])
def test_edges_lie_where_half_of_the_light_does(white: bool) -> None:
    square, floor = (200.0, 40.0) if white else (40.0, 170.0)
    photo = Photo(yaw=17.0, blur=0.8, noise=1.0, square_level=square, floor_level=floor)
    image = render(photo)
    assert corner_errors(find(image)[0].corners, photo.corners).max() < 0.05
    assert corner_errors(find(image, gamma="linear")[0].corners, photo.corners).min() > 0.2
    image = render(replace(photo, gamma=1.8))
    assert corner_errors(find(image, gamma=1.8)[0].corners, photo.corners).max() < 0.05


@pytest.mark.parametrize("white", [True, False])
@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_camera_that_sharpens_does_not_move_the_edges(white: bool, share: float) -> None:
    # Without regard to it the corners are 0.07 to 0.2 px off, all of them outwards or inwards.
    square, floor = (200.0, 50.0) if white else (50.0, 170.0)
    photo = Photo(yaw=17.0, blur=0.6, noise=1.0, square_level=square, floor_level=floor)
    found = find(render(replace(photo, sharpening=share)))[0]
    assert corner_errors(found.corners, photo.corners).max() < 0.05


def test_texture_beside_a_dark_square_moves_it_little() -> None:
    errors = []
    for seed in range(3):
        photo = Photo(
            seed, yaw=25.0, blur=0.8, noise=1.0, square_level=40.0, floor_level=180.0, texture=8.0
        )
        errors.append(corner_errors(find(render(photo))[0].corners, photo.corners))
    assert np.median(errors) < 0.06
    assert np.max(errors) < 0.15


def test_a_line_of_the_same_paint_along_a_side_and_through_a_corner_does_not_move_it() -> None:
    lines = ((1.0, 0.85, 6.0, 0.85, 0.04572), (-1.0, -1.0, -1.0, -6.0, 0.03), (0, 1, 0, 6, 0.04))
    photo = Photo(yaw=9.0, noise=5.0, lines=lines)
    square = find(render(photo))[0]
    assert corner_errors(square.corners, photo.corners).max() < 0.2


def test_the_square_is_preferred_to_oblongs_and_the_larger_square_to_smaller_ones() -> None:
    photo = Photo(
        noise=4.0,
        height=0.4,
        yaw=12.0,
        centre=(0.6, 0.1),
        other_squares=((1.2, -0.25, 20.0, 0.15), (0.45, -0.35, 5.0, 0.12)),
        boxes=((1.0, 0.35, 0.2, 0.45), (0.34, 0.1, 0.1, 0.3)),
    )
    square = find(render(photo))[0]
    assert corner_errors(square.corners, photo.corners).max() < 0.2


def test_two_similar_squares_are_both_reported() -> None:
    other = (0.72, -0.22, -10.0, 0.3)
    photo = Photo(noise=4.0, height=0.45, centre=(0.7, 0.2), side=0.3, other_squares=(other,))
    found = find(render(photo))
    assert len(found) >= 2
    assert corner_errors(found[0].corners, photo.corners).max() > 20 or (
        corner_errors(found[1].corners, photo.corners).max() > 20
    )


def test_a_coloured_square_as_bright_as_the_floor_is_found() -> None:
    photo = Photo(yaw=-14.0, square_level=200.0, floor_level=40.0)
    low, high = light_of_gray(40.0), light_of_gray(200.0)
    share = (light_of_image(render(photo)[..., :1], "srgb") - low) / (high - low)
    # Both colours have a luminance of about 120.
    red, green = (
        light_of_image(np.array(colour, np.uint8), "srgb")
        for colour in ((40, 40, 255), (60, 145, 90))
    )
    mixed = share * red + (1 - share) * green
    image = np.rint(codes_of_light(mixed.clip(0, 255), "srgb")).astype(np.uint8)
    (square, *_) = find(image)
    assert corner_errors(square.corners, photo.corners).max() < 0.1


def test_a_bent_square_is_straightened_by_a_known_lens() -> None:
    photo = Photo(yaw=20.0, noise=2.0, distortion=(-0.25, 0.06, 0.0, 0.0, 0.0))
    (square, *_) = find(render(photo), photo.intrinsics)
    assert corner_errors(square.corners, photo.corners).max() < 0.06
    assert abs(square.quad.bow_pixels) < 0.1


def test_a_bent_square_without_a_known_lens_keeps_its_corners_and_shows_its_bow() -> None:
    photo = Photo(yaw=0.0, centre=(0.5, 0.0), noise=2.0, distortion=(-0.25, 0.06, 0.0, 0.0, 0.0))
    (square, *_) = find(render(photo))
    assert corner_errors(square.corners, photo.corners).max() < 0.35
    assert abs(square.quad.bow_pixels) > 1.0


def test_the_covariance_matches_the_errors_of_the_corners() -> None:
    ratios = []
    for seed in range(4):
        photo = random_photo(300 + seed, hard=False)
        square = find(render(photo))[0]
        sigma = np.sqrt(np.diag(square.quad.covariance))
        ratios.append(
            corner_errors(square.corners, photo.corners) / np.hypot(*sigma.reshape(4, 2).T)
        )
    assert 0.2 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_given_corners_are_moved_to_the_edges() -> None:
    photo = Photo(yaw=17.0, noise=3.0)
    image = render(photo)
    true = calibrate.sort_corners(photo.corners, photo.size)
    given = true + np.array([[2.0, -1.0], [-1.5, 2.0], [1.0, 2.0], [-2.0, -1.0]])
    square = refine_square(image, given, plain_lens(photo.size))
    assert corner_errors(square.corners, photo.corners).max() < 0.1


def test_given_corners_without_edges_are_refused() -> None:
    image = np.full((480, 640, 3), 90, np.uint8)
    corners = np.array([[100.0, 100.0], [300.0, 110.0], [310.0, 300.0], [90.0, 290.0]])
    with pytest.raises(CalibrationError, match="no edges"):
        refine_square(image, corners, plain_lens((640, 480)))


def textured_floor() -> np.ndarray:
    return render(Photo(texture=14.0, noise=6.0, side=1e-4))


def blobs() -> np.ndarray:
    image = np.full((480, 640, 3), 70, np.uint8)
    cv2.circle(image, (300, 250), 90, (190, 190, 190), -1)
    cv2.fillPoly(image, [np.array([[450, 400], [560, 260], [600, 420]])], (200, 200, 200))
    return image


@pytest.mark.parametrize("make", [textured_floor, blobs, lambda: np.zeros((480, 640, 3), np.uint8)])
def test_no_square_is_said_to_be_none(make: object) -> None:
    with pytest.raises(CalibrationError, match="--corners"):
        find(make())  # type: ignore[operator]


@pytest.mark.parametrize(
    ("name", "corners", "limit"),
    [
        ("gazebo/cap6.jpg", [(922, 220), (688, 27), (276, 27), (7, 218)], 2.0),
        ("gazebo/calibrate.jpg", [(623, 178), (453, 31), (187, 31), (18, 178)], 2.0),
        ("course/c01.jpg", [(1239, 511), (1642, 513), (1890, 570), (1342, 570)], 4.0),
    ],
)
def test_the_squares_of_the_published_photos_are_found(
    data_folder: Path, name: str, corners: list[tuple[int, int]], limit: float
) -> None:
    image = cv2.imread(str(data_folder / name))
    square = find(np.asarray(image, dtype=np.uint8))[0]
    assert corner_errors(square.corners, np.array(corners, float)).max() < limit


def test_equal_photos_give_equal_bits() -> None:
    image = render(random_photo(5, hard=True))
    first, second = find(image)[0], find(image)[0]
    assert np.array_equal(first.corners, second.corners)
    assert np.array_equal(first.quad.covariance, second.quad.covariance)
