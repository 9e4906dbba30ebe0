"""The simulated camera in light: what it adds up, and what each of its parts does to a picture."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from slamcli.core.camera.lens import undistorted_coordinates
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.core.light import encode, light_in_16_bits, light_of_gray
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import (
    CameraOptions,
    DisturbanceOptions,
    FloorOptions,
    ImagingOptions,
)
from slamcli.simulation.photograph.imaging import Sensor

SIZE = (320, 240)
CAMERA = CameraOptions(size=SIZE, height_metres=0.3, pitch_degrees=45.0)
PLAIN = ImagingOptions(lens_blur_pixels=0.0)
QUIET = DisturbanceOptions(noise_gray=0.0, vignetting=0.0)


def develop(
    light: np.ndarray, options: ImagingOptions, noise_gray: float = 0.0, gain: float = 1.0
) -> np.ndarray:
    """Return what a camera writes of light of its own size."""
    size = light.shape[1], light.shape[0]
    generator = np.random.default_rng(1)
    return Sensor(size, options, 0.0, 0).develop(light, gain, noise_gray, generator)


def even(gray: float) -> np.ndarray:
    return np.full((SIZE[1], SIZE[0], 3), light_of_gray(gray), np.float32)


def test_light_and_its_code_are_inverses() -> None:
    gray = np.arange(256, dtype=np.uint8).reshape(1, 256, 1)
    light = light_in_16_bits(gray).astype(np.float32) * np.float32(255.0 / 65535.0)
    np.testing.assert_allclose(encode(light).ravel(), gray.ravel(), atol=0.05)
    # IEC 61966-2-1: half of the light is gray 188, and gray 128 is 21.6 % of it.
    assert float(encode(np.full((1, 1), 127.5, np.float32))[0, 0]) == pytest.approx(187.5, abs=0.1)
    assert light_of_gray(128.0) == pytest.approx(0.2159 * 255.0, abs=0.02)


def stripes(*, in_light: bool) -> floors.BlockFloor:
    """Return a floor of black and white stripes, far finer than a pixel."""

    def paint(grid: Grid) -> np.ndarray:
        left = round(grid.x_min / grid.metres_per_pixel)
        row = np.where((left + np.arange(grid.width)) % 2 == 0, 0, 255).astype(np.uint8)
        return np.ascontiguousarray(
            np.broadcast_to(row[None, :, None], (grid.height, grid.width, 3))
        )

    return floors.BlockFloor(paint, 0.00005, in_light=in_light)


@pytest.mark.parametrize(("in_light", "gray"), [(True, 187.5), (False, 127.5)])
def test_floor_finer_than_a_pixel_is_a_mean_of_light_or_of_gray(
    in_light: bool, gray: float
) -> None:
    world = photograph.World(stripes(in_light=in_light))
    calibration = photograph.make_camera(replace(CAMERA, size=(40, 30)))
    photographer = photograph.Photographer(world, calibration, PLAIN)
    image = photograph.take(photographer, (Pose2(), Pose2()), 0.0, QUIET, np.random.default_rng(0))
    np.testing.assert_allclose(image[15:].mean(), gray, atol=1.0)


def test_photon_noise_grows_with_light_and_is_as_given_at_the_mid_tone() -> None:
    middle = 255.0 * (1.055 * 0.18 ** (1 / 2.4) - 0.055)
    code = develop(even(middle), PLAIN, noise_gray=4.0).astype(float)
    assert code.std() == pytest.approx(4.0, rel=0.05)
    assert code.mean() == pytest.approx(middle, abs=0.3)
    sigmas = {}
    for gray in (middle, 220.0):
        light = light_in_16_bits(develop(even(gray), PLAIN, noise_gray=4.0)).astype(float)
        sigmas[gray] = light.std()
    # The variance of a number of photons is that number.
    ratio = np.sqrt(light_of_gray(220.0) / light_of_gray(middle))
    assert sigmas[220.0] / sigmas[middle] == pytest.approx(ratio, rel=0.08)


def test_noise_of_a_colour_filter_is_shared_by_neighbours_and_its_edges_have_colours() -> None:
    single = develop(even(118.0), PLAIN, noise_gray=6.0).astype(float)
    filtered = develop(even(118.0), replace(PLAIN, bayer=True), noise_gray=6.0).astype(float)

    def likeness(image: np.ndarray) -> float:
        centred = image[..., 0] - image[..., 0].mean()
        return float((centred[:, 1:] * centred[:, :-1]).mean() / centred.var())

    assert abs(likeness(single)) < 0.02
    assert likeness(filtered) > 0.2
    edge = even(60.0)
    edge[:, 121:] = light_of_gray(220.0)
    code = develop(edge, replace(PLAIN, bayer=True)).astype(float)
    colour = np.ptp(code, axis=2).max(axis=0)
    assert colour[115:127].max() > 20
    assert colour[:100].max() <= 1


def test_sharpening_has_a_halo_and_the_lens_none() -> None:
    edge = even(60.0)
    edge[:, 160:] = light_of_gray(180.0)
    soft = develop(edge, ImagingOptions(lens_blur_pixels=0.8))[120, :, 1].astype(int)
    assert (np.diff(soft) >= 0).all()
    crisp = develop(edge, ImagingOptions(lens_blur_pixels=0.8, sharpening=1.0))[120, :, 1]
    assert crisp.max() > 185
    assert crisp.min() < 55


def test_auto_exposure_brings_all_pictures_to_the_same_mean_light() -> None:
    options = replace(PLAIN, auto_exposure=True)
    means = [
        light_in_16_bits(develop(even(gray), options, gain=gain)).mean() / 65535.0
        for gray, gain in ((60.0, 1.0), (200.0, 0.6))
    ]
    np.testing.assert_allclose(means, 0.18, atol=0.003)


def test_the_lamp_and_dust_stay_where_they_are() -> None:
    options = ImagingOptions(lamp_share=0.2, dust=6)
    first, second = develop(even(100.0), options), develop(even(150.0), options)
    assert np.ptp(first) > 20
    light = [light_in_16_bits(code).astype(float) for code in (first, second)]
    shares = [values / np.median(values) for values in light]
    np.testing.assert_allclose(shares[0], shares[1], atol=0.03)


def test_a_rolling_shutter_sees_each_row_from_where_the_robot_is_by_then() -> None:
    calibration = photograph.make_camera(CAMERA)
    floor = floors.make_floor("asphalt", FloorOptions(), 0.001, 3, in_light=True)
    photographer = photograph.Photographer(photograph.World(floor), calibration, PLAIN)
    first, last = Pose2(), Pose2(0.04, 0.0, 0.05)
    rolled = photographer.expose(photograph.Shutter(first, last), calibration, 0.0)
    motion = first.inverse() @ last
    for row in (20, 120, 220):
        share = (row + 0.5) / SIZE[1]
        pose = first @ Pose2(share * motion.x, share * motion.y, share * motion.theta)
        still = photographer.expose(photograph.Shutter(pose, pose), calibration, 0.0)
        error = np.abs(rolled[row] - still[row]).mean()
        before = photographer.expose(photograph.Shutter(first, first), calibration, 0.0)
        assert error < 0.1 * np.abs(rolled[row] - before[row]).mean() + 0.4


@pytest.mark.parametrize("in_light", [True, False])
def test_pictures_are_those_of_many_rays_one_by_one(in_light: bool) -> None:
    """The renderer by tiles and levels, beside every ray read at the floor's own resolution."""
    camera = CameraOptions(size=(160, 120), height_metres=0.3, pitch_degrees=45.0, k1=-0.15)
    calibration = photograph.make_camera(camera)
    floor = floors.make_floor("asphalt", FloorOptions(), 0.001, 3, in_light=in_light)
    photographer = photograph.Photographer(photograph.World(floor), calibration)
    pose = Pose2(0.3, -0.2, 0.4)
    image = photographer.expose(photograph.Shutter(pose, pose), calibration, 0.0)
    fine, (width, height) = 8, calibration.image_size
    columns, rows = np.meshgrid(
        (np.arange(width * fine) + 0.5) / fine - 0.5, (np.arange(height * fine) + 0.5) / fine - 0.5
    )
    x, y = undistorted_coordinates(calibration, columns.astype(np.float32), rows.astype(np.float32))
    seen = pose.matrix @ calibration.robot_from_image
    places = apply_homography(seen, np.dstack([x, y]).astype(np.float64))
    ends = places.reshape(-1, 2)
    grid = Grid.covering([ends.min(axis=0) - 0.01, ends.max(axis=0) + 0.01], 0.001)
    pixels = apply_homography(grid.pixel_from_metres, places).astype(np.float32)
    read = cv2.remap(floor.region(grid), pixels, None, cv2.INTER_LINEAR).astype(np.float32)
    if in_light:
        read *= 255.0 / 65535.0
    expected = cv2.resize(read, (width, height), interpolation=cv2.INTER_AREA)
    difference = (image - expected)[..., 1]
    contrast = expected[..., 1].std()
    assert difference.std() < 0.12 * contrast
    assert abs(difference.mean()) < 0.02 * contrast
    # By least squares, the shift that explains the difference best.
    slopes = [np.gradient(expected[..., 1], axis=axis).ravel() for axis in (1, 0)]
    shift = np.linalg.lstsq(np.column_stack(slopes), difference.ravel(), rcond=None)[0]
    np.testing.assert_allclose(shift, 0.0, atol=0.01)


def test_floors_in_light_are_those_of_encoded_gray_in_look() -> None:
    """Their noise is drawn otherwise, with the same spread."""
    for kind in ("asphalt", "concrete", "tiles"):
        levels = [
            floors.make_floor(kind, FloorOptions(), 0.001, 3, in_light=in_light).region(
                Grid(0.0, 0.0, 0.001, 700, 650)
            )
            for in_light in (True, False)
        ]
        gray = [encode(levels[0] * np.float32(255.0 / 65535.0)), levels[1].astype(np.float32)]
        # Without the clouds, of which the piece has only a few.
        grain = [image - cv2.GaussianBlur(image, (0, 0), 12.0) for image in gray]
        assert float(grain[0].std()) == pytest.approx(grain[1].std(), rel=0.1)
        skews = [((image / image.std()) ** 3).mean() for image in grain]
        assert skews[0] == pytest.approx(skews[1], rel=0.35, abs=0.3)


def test_marks_lie_where_the_list_of_them_says() -> None:
    surface = FloorOptions(wear=0.0, tile_metres=0.2, marks=3)
    plain = replace(surface, marks=0)
    grid = Grid(-0.4, 0.2, 0.0005, 400, 400)
    marked, bare = (
        floors.make_floor("tiles", options, 0.0005, 7).region(grid).astype(int)
        for options in (surface, plain)
    )
    changed = np.abs(marked - bare).max(axis=2)
    marks = floors.laid.tile_marks(surface, -2, 0, 7)
    assert len(marks) == 3
    total = np.zeros(changed.shape, bool)
    for mark in marks:
        column, row = apply_homography(grid.pixel_from_metres, mark.centre)
        across, down = mark.radii / 0.0005 + 2
        rows, columns = np.ogrid[: grid.height, : grid.width]
        total |= ((columns - column) / across) ** 2 + ((rows - row) / down) ** 2 <= 1.0
        assert changed[round(row), round(column)] > 8
    tile = (slice(0, 400), slice(0, 400))
    assert not changed[tile][~total[tile]].any()
