"""Surveys: nadir frames whose height and tilt vary, on floors with truth."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam
from flights import FOCAL, RADIUS, SIZE, floor_picture, nadir_states, photographs
from trajectories import read_rows

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Rocking, top_down_calibration
from slamcli.core.camera.mounting import rocked, top_down_homography
from slamcli.core.geometry import apply_homography, invert
from slamcli.io.images.canvas import common_canvas, on_canvas
from slamcli.survey import candidates, survey, survey_features
from slamcli.survey.lens import Lens, LensPrior
from slamcli.survey.network import connected
from slamcli.survey.pairs import find_pair
from slamcli.survey.projection import STATES, project


def trajectory_error(found: Float64Array, truth: Float64Array) -> float:
    """Return the root mean square distance after one similarity."""
    z, w = found @ [1.0, 1.0j], truth @ [1.0, 1.0j]
    z, w = z - z.mean(), w - w.mean()
    factor = np.vdot(z, w) / np.vdot(z, z)
    return float(np.sqrt(np.mean(np.abs(factor * z - w) ** 2)))


@pytest.fixture(scope="module")
def flight() -> tuple[Float64Array, list[UInt8Array]]:
    states = nadir_states(4, 6, np.random.default_rng(1))
    return states, photographs(floor_picture(), states)


def test_height_and_tilt_of_a_flight_are_found(
    flight: tuple[Float64Array, list[UInt8Array]],
) -> None:
    states, pictures = flight
    features = [survey_features(picture) for picture in pictures]
    found = survey(features, Lens(FOCAL, 0.0, RADIUS))
    assert [len(one.frames) for one in found.maps] == [24]
    bundle = found.maps[0].bundle
    length = np.linalg.norm(np.diff(states[:, :2], axis=0), axis=1).sum()
    assert trajectory_error(bundle.states[:, :2], states[:, :2]) < 0.001 * length
    assert np.corrcoef(bundle.states[:, 3], states[:, 3])[0, 1] > 0.98
    assert math.radians(1.0) < bundle.mount.tilt_sigma < math.radians(4.0)
    assert np.median(bundle.pair_pixels) < 0.5


def test_the_focal_length_of_a_camera_that_tilts_is_found(
    flight: tuple[Float64Array, list[UInt8Array]],
) -> None:
    states, pictures = flight
    features = [survey_features(picture) for picture in pictures]
    guess = 1.3 * FOCAL
    found = survey(features, Lens(guess, 0.0, RADIUS, LensPrior(math.log(guess), 0.5)))
    bundle = found.maps[0].bundle
    assert bundle.lens.focal_pixels == pytest.approx(FOCAL, rel=0.01)
    np.testing.assert_allclose(bundle.states[:, 4:], states[:, 4:], atol=math.radians(0.2))


def test_the_focal_length_of_photos_from_all_sides_is_found() -> None:
    generator = np.random.default_rng(10)
    states = nadir_states(2, 4, generator)
    states[:, 4:] = np.radians(generator.uniform(-30.0, 30.0, (len(states), 2)))
    features = [survey_features(picture) for picture in photographs(floor_picture(), states)]
    guess = 1.6 * FOCAL
    found = survey(features, Lens(guess, 0.0, RADIUS, LensPrior(math.log(guess), 0.5)))
    assert [len(one.frames) for one in found.maps] == [8]
    bundle = found.maps[0].bundle
    assert bundle.lens.focal_pixels == pytest.approx(FOCAL, rel=0.02)
    assert trajectory_error(bundle.states[:, :2], states[:, :2]) < 1.0


def test_a_flight_in_any_order_is_one_map(
    flight: tuple[Float64Array, list[UInt8Array]],
) -> None:
    states, pictures = flight
    order = np.random.default_rng(2).permutation(len(pictures))
    features = [survey_features(pictures[number]) for number in order]
    found = survey(features, Lens(FOCAL, 0.0, RADIUS))
    assert [len(one.frames) for one in found.maps] == [24]
    error = trajectory_error(found.maps[0].bundle.states[:, :2], states[order, :2])
    assert error < 1.0


def test_stitch_without_options_maps_a_flight(
    flight: tuple[Float64Array, list[UInt8Array]], tmp_path: Path
) -> None:
    states, pictures = flight
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, picture in enumerate(pictures[:6]):
        # One of another size, as cameras and people leave them.
        kept = cv2.resize(picture, (192, 144)) if number == 0 else picture
        cv2.imwrite(str(frames / f"{number:02}.png"), kept)
    for workers in (1, 2):
        result = slam("stitch", frames, "-o", tmp_path / f"map{workers}", "--workers", workers)
        assert result.exit_code == 0, result.output
    assert "six degrees of freedom" in result.output
    rows = read_rows(tmp_path / "map1" / "poses.csv")
    assert [row["status"] for row in rows] == ["tracked"] * 6
    assert {row["fragment"] for row in rows} == {"0"}
    places = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    assert trajectory_error(places, states[:6, :2]) < 1.5
    for name in ("poses.csv", "mosaic.png"):
        first, second = (tmp_path / f"map{n}" / name for n in (1, 2))
        assert first.read_bytes() == second.read_bytes()
    mosaic = tmp_path / "map1" / "mosaic.png"
    result = slam("render", tmp_path / "map1", "-o", tmp_path / "again")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "again" / "mosaic.png").read_bytes() == mosaic.read_bytes()


def test_a_rigid_top_down_drive_stays_on_its_path(tmp_path: Path) -> None:
    floor, frames = floor_picture(), tmp_path / "frames"
    frames.mkdir()
    for number in range(5):
        part = floor[100:292, 50 + 40 * number : 306 + 40 * number]
        cv2.imwrite(str(frames / f"{number}.png"), part)
    result = slam("stitch", frames, "-o", tmp_path / "map")
    assert result.exit_code == 0, result.output
    assert "six degrees" not in result.output
    rows = read_rows(tmp_path / "map" / "poses.csv")
    assert [row["rocking_height"] for row in rows] == [""] * 5


def test_frames_of_two_floors_are_two_maps() -> None:
    states = nadir_states(1, 3, np.random.default_rng(5))
    pictures = photographs(floor_picture(seed=1), states) + photographs(
        floor_picture(seed=2), states
    )
    found = survey([survey_features(one) for one in pictures], Lens(FOCAL, 0.0, RADIUS))
    assert [one.frames for one in found.maps] == [(0, 1, 2), (3, 4, 5)]


def test_a_pair_of_strangers_says_why() -> None:
    blank = survey_features(np.full(SIZE[::-1], 90, np.uint8))
    assert len(blank) == 0
    assert find_pair(0, 1, blank, blank).reason == "too few matches"
    states = nadir_states(1, 1, np.random.default_rng(5))
    first, second = (survey_features(photographs(floor_picture(seed=n), states)[0]) for n in (1, 2))
    assert find_pair(0, 1, first, second).reason


def test_projections_agree_with_the_camera_that_is_painted_from() -> None:
    state = np.array([[0.0, 0.0, 0.0, 0.1, 0.05, -0.08]])
    calibration = top_down_calibration(SIZE)
    matrix = calibration.camera_matrix.copy()
    focal = float(matrix[0, 0])
    rocking = Rocking(0.05, -0.08, focal * (math.exp(0.1) - 1.0))
    moved = rocked(calibration, rocking)
    points = np.array([[10.0, 20.0], [-50.0, 30.0]])
    pixels = apply_homography(moved.image_from_robot, points) - matrix[:2, 2]
    expected = apply_homography(project(state, focal).image_from_map[0], points)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    level = top_down_homography(matrix, Rocking())
    np.testing.assert_allclose(invert(level), calibration.robot_from_image, atol=1e-9)


def test_derivatives_of_a_projection() -> None:
    generator = np.random.default_rng(0)
    state = generator.normal(0.0, 0.3, (1, STATES))
    found = project(state, FOCAL)
    for column in range(STATES):
        step = np.zeros_like(state)
        step[0, column] = 1e-6
        change = project(state + step, FOCAL).image_from_map
        change = (change - project(state - step, FOCAL).image_from_map) / 2e-6
        np.testing.assert_allclose(found.by_state[0, column], change[0], atol=1e-6)
    change = project(state, FOCAL * math.exp(1e-6)).image_from_map
    change = (change - project(state, FOCAL * math.exp(-1e-6)).image_from_map) / 2e-6
    np.testing.assert_allclose(found.by_log_focal, change, atol=1e-9)


def test_candidates() -> None:
    assert candidates.by_sequence(3) == [(0, 1), (0, 2), (1, 2)]
    assert len(candidates.compared(10)) == 45
    assert len(candidates.compared(1000)) <= 20_000
    assert candidates.by_appearance([(0, 1), (0, 2)], [3, 9]) == [(0, 2)]
    assert connected([], 2) == [[0], [1]]


def test_pictures_of_other_sizes_lie_on_one_canvas() -> None:
    assert common_canvas([(40, 30), (80, 60), (80, 60)]) == (80, 60)
    assert common_canvas([(80, 60), (80, 60), (60, 80)]) == (80, 80)
    small = np.full((30, 40), 7, np.uint8)
    enlarged, mask = on_canvas(small, None, (80, 60))
    assert enlarged.shape == (60, 80)
    assert mask is None
    padded, mask = on_canvas(np.full((80, 60), 7, np.uint8), None, (80, 80))
    assert padded.shape == (80, 80)
    assert mask is not None
    assert mask[40, 40] == 255
    assert mask[40, 2] == 0


def test_a_level_camera_has_no_tilt(flight: tuple[Float64Array, list[UInt8Array]]) -> None:
    states = flight[0][:6].copy()
    states[:, 4:] = 0.0
    features = [survey_features(one) for one in photographs(floor_picture(), states)]
    guess = 1.3 * FOCAL
    lens = Lens(guess, 0.0, RADIUS, LensPrior(math.log(guess), 0.5))
    found = survey(features, lens, level=True).maps[0].bundle
    assert not found.states[:, 4:].any()
    np.testing.assert_allclose(np.diff(found.states[:, 3]), np.diff(states[:, 3]), atol=0.002)
    assert trajectory_error(found.states[:, :2], states[:, :2]) < 0.2
