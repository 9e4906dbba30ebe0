"""The bird's-eye view, from pictures whose floor is known."""

from __future__ import annotations

import numpy as np
import pytest

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint, footprint_hull
from slamcli.core.camera.lens import undistort_points
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.core.records import Frame, View
from slamcli.simulation import photograph
from slamcli.simulation.config import CameraOptions
from slamcli.stages import view


def calibration_of(pitch_degrees: float = 40.0) -> Calibration:
    matrix = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    pitch = np.radians(pitch_degrees)
    return Calibration(
        camera_matrix=matrix,
        distortion=np.array([-0.15, 0.03, 0.0, 0.0, 0.0]),
        distortion_model="plumb_bob",
        image_size=(640, 480),
        robot_from_image=compose_robot_from_image(matrix, 0.4, pitch, 0.0),
        height_metres=0.4,
        pitch_radians=pitch,
        roll_radians=0.0,
        max_range_metres=1.2,
    )


def picture_of(calibration: Calibration, wavelength_metres: float) -> Frame:
    """A floor whose brightness is a known smooth function of the place."""
    columns, rows = np.meshgrid(np.arange(640.0), np.arange(480.0))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    floor = apply_homography(calibration.robot_from_image, undistort_points(calibration, pixels))
    gray = brightness(floor, wavelength_metres).reshape(480, 640)
    return Frame(0, "waves", None, np.round(gray).astype(np.uint8))


def brightness(floor: np.ndarray, wavelength_metres: float) -> np.ndarray:
    phase = 2 * np.pi * floor / wavelength_metres
    return 128 + 50 * np.sin(phase[:, 0]) + 50 * np.cos(phase[:, 1])


def test_a_far_view_is_made_where_it_shows_more_floor() -> None:
    level = calibration_of(pitch_degrees=30.0)
    far = view.make_far_resampler(level, 0.005)
    assert far is not None
    near = view.make_view_resampler(level, 0.005)
    assert far.grid.metres_per_pixel == 0.01
    assert far.grid.x_max > 1.5 * near.grid.x_max
    # A camera that looks down sees all of its floor within the range.
    assert view.make_far_resampler(calibration_of(pitch_degrees=75.0), 0.005) is None


def test_the_view_shows_each_spot_of_the_floor_at_its_place() -> None:
    calibration = calibration_of()
    resampler = view.make_view_resampler(calibration, 0.002)
    seen = view.make_view(picture_of(calibration, 0.2), resampler, gray=True)
    rows, columns = np.nonzero(seen.mask)
    floor = apply_homography(seen.grid.metres_from_pixel, np.column_stack([columns, rows]))
    error = seen.image[rows, columns] - brightness(floor, 0.2)
    assert np.abs(error).max() < 6.0
    assert abs(error.mean()) < 0.1


@pytest.mark.parametrize("size", [(640, 480), (1920, 1080)])
def test_views_have_as_many_pixels_as_matching_needs(size: tuple[int, int]) -> None:
    calibration = photograph.make_camera(CameraOptions(size=size))
    grid = footprint(calibration, view.registration_metres_per_pixel(calibration))
    assert grid.width * grid.height == pytest.approx(0.5e6, rel=0.02)


def test_fine_texture_does_not_alias_where_the_raster_is_coarse() -> None:
    calibration = calibration_of(pitch_degrees=60.0)
    grid = Grid.covering(footprint_hull(calibration), 0.01)
    resampler = view.make_resampler(calibration, resolution_image(calibration), grid, Pose2())
    seen = view.make_view(picture_of(calibration, 0.009), resampler, gray=True)
    near = seen.image[seen.mask > 0]
    assert near.std() < 15.0


def test_masked_pixels_are_not_seen() -> None:
    calibration = calibration_of()
    resampler = view.make_view_resampler(calibration, 0.005)
    frame = picture_of(calibration, 0.2)
    mask = np.full((480, 640), 255, np.uint8)
    mask[:, :320] = 0
    seen = view.make_view(Frame(0, "half", None, frame.image, mask), resampler, gray=True)
    rows, columns = np.nonzero(seen.mask)
    floor = apply_homography(seen.grid.metres_from_pixel, np.column_stack([columns, rows]))
    assert floor[:, 1].max() < 0.005


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((480, 640, 3), np.uint8), "black"),
        (np.full((480, 640), 255, np.uint8), "white"),
        (np.full((480, 640), 120, np.uint8), "blank"),
    ],
)
def test_a_floor_that_shows_nothing_is_refused(image: np.ndarray, reason: str) -> None:
    calibration = calibration_of()
    resampler = view.make_view_resampler(calibration, 0.005)
    seen = view.make_view(Frame(0, "f", None, image), resampler, gray=True)
    with pytest.raises(FrameError, match=reason):
        view.check_view(seen)


def test_an_overexposed_floor_is_refused() -> None:
    image = np.full((50, 50), 255, np.uint8)
    image[0, :30] = 0
    overexposed = View(Grid(0, 0, 1, 50, 50), image, np.full((50, 50), 255, np.uint8))
    with pytest.raises(FrameError, match="overexposed"):
        view.check_view(overexposed)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((100, 640, 3), np.uint8), "640x100"),
        (np.zeros((480, 640, 4), np.uint8), "shape"),
        (np.zeros((480, 640, 3), np.float32), "8-bit"),
        (None, "8-bit"),
    ],
)
def test_a_frame_of_another_kind_is_refused(image: np.ndarray, reason: str) -> None:
    with pytest.raises(FrameError, match=reason):
        view.check_frame(Frame(0, "f", None, image), calibration_of())


@pytest.mark.parametrize("sigma", [2.0, 6.0, 12.0])
def test_the_noise_of_a_frame_is_separated_from_the_texture_of_the_floor(sigma: float) -> None:
    generator = np.random.default_rng(4)
    flat = np.full((480, 640), 110.0)
    # Grains of a few pixels, four times as strong as the noise.
    grains = np.kron(generator.normal(0.0, 4.0 * sigma, (120, 160)), np.ones((4, 4)))
    grains[:, :200] = 0.0
    for floor in (flat, flat + grains):
        noisy = floor + generator.normal(0.0, sigma, floor.shape)
        measured = view.noise_gray(np.clip(noisy, 0, 255).round().astype(np.uint8))
        assert measured == pytest.approx(sigma, rel=0.15)


def test_a_frame_that_is_burnt_out_has_no_noise_to_measure() -> None:
    assert view.noise_gray(np.full((480, 640), 255, np.uint8)) == 0.0
    assert view.noise_gray(np.full((30, 30), 128, np.uint8)) == 0.0
