"""The camera above the floor, from simulated squares whose every number is known."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from photo_files import exif_of, write_photo
from square_photos import SIDE_METRES, Photo, random_photo, render, rotation

from slamcli.cli.main import main
from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.lens import distort_points, undistort_points
from slamcli.core.camera.resolution import floor_sampling
from slamcli.core.errors import CalibrationError, InputError, OutputError
from slamcli.core.geometry import apply_homography
from slamcli.io.calibrations import load_calibration, save_calibration
from slamcli.run.calibrate import CalibrateOptions
from slamcli.run.calibrate import calibrate as run_calibrate
from slamcli.run.calibrate.mountings import choose_best, floor_areas
from slamcli.stages import calibrate
from slamcli.stages.calibrate import board

SQUARE = CalibrateOptions(side_metres=SIDE_METRES)


def floor_distance_errors(photo: Photo, calibration: Calibration) -> np.ndarray:
    """Relative errors between seen lattice points up to three squares away from the square's."""
    lattice = np.array([(i, j) for i in range(-7, 8) for j in range(-7, 8)]) * photo.side / 2
    floor = lattice @ rotation(photo.yaw).T + photo.centre
    depth = floor @ photo.image_from_robot[2, :2] + photo.image_from_robot[2, 2]
    floor = floor[depth > 0.02]
    pixels = distort_points(photo.intrinsics, apply_homography(photo.image_from_robot, floor))
    seen = np.all((pixels >= 0) & (pixels <= np.array(photo.size) - 1), axis=1)
    undistorted = undistort_points(calibration, pixels[seen])
    measured = apply_homography(calibration.robot_from_image, undistorted)
    first, second = np.triu_indices(int(seen.sum()), 1)
    true = np.linalg.norm(floor[seen][first] - floor[seen][second], axis=1)
    found = np.linalg.norm(measured[first] - measured[second], axis=1)
    apart = true >= 0.99 * photo.side
    return np.abs(found / true - 1.0)[apart]


def save_photo(photo: Photo, path: Path) -> Path:
    cv2.imwrite(str(path), render(photo))
    return path


def run(photo: Photo, folder: Path, options: CalibrateOptions = SQUARE) -> Calibration:
    picture = save_photo(photo, folder / "square.png")
    run_calibrate([picture], folder / "out.yaml", options, overwrite=True)
    return load_calibration(folder / "out.yaml")


def solve(photo: Photo, corners: np.ndarray, sigma: float, *, known: bool) -> calibrate.Mounting:
    ordered = calibrate.sort_corners(corners, photo.size)
    undistorted = undistort_points(photo.intrinsics, ordered) if known else ordered
    points = calibrate.FloorPoints(
        calibrate.square_target(photo.side), undistorted, np.eye(8) * sigma**2
    )
    if known:
        return calibrate.solve_mounting_with_intrinsics(points, photo.intrinsics)
    return calibrate.solve_mounting(points, photo.size)


@pytest.mark.parametrize("seed", range(20))
def test_simulated_squares_calibrate_within_the_limits(seed: int, tmp_path: Path) -> None:
    photo = random_photo(seed, hard=False)
    calibration = run(photo, tmp_path)
    assert floor_distance_errors(photo, calibration).max() < 0.01
    assert calibration.height_metres == pytest.approx(photo.height, rel=0.02)
    assert math.degrees(calibration.pitch_radians) == pytest.approx(photo.pitch, abs=0.3)
    assert math.degrees(calibration.roll_radians) == pytest.approx(photo.roll, abs=0.3)


@pytest.mark.parametrize("yaw", [0.0, 1e-7, 30.0, 45.0, 90.0])
@pytest.mark.parametrize("roll", [0.0, 4.0])
def test_exact_corners_give_the_exact_camera(yaw: float, roll: float) -> None:
    photo = Photo(yaw=yaw, roll=roll)
    mounting = solve(photo, photo.corners, 0.1, known=False)
    assert mounting.focal_pixels == pytest.approx(photo.focal, rel=1e-6)
    assert mounting.height_metres == pytest.approx(photo.height, rel=1e-6)
    assert math.degrees(mounting.pitch_radians) == pytest.approx(photo.pitch, abs=1e-5)
    assert math.degrees(mounting.roll_radians) == pytest.approx(photo.roll, abs=1e-5)
    assert mounting.residual_pixels < 1e-6


def test_the_sigmas_match_the_errors_of_the_numbers() -> None:
    photo = Photo(yaw=25.0, roll=2.0)
    generator = np.random.default_rng(4)
    scores = []
    for _ in range(60):
        noisy = photo.corners + generator.normal(scale=0.2, size=(4, 2))
        mounting = solve(photo, noisy, 0.2, known=False)
        errors = np.array(
            [
                mounting.focal_pixels - photo.focal,
                mounting.height_metres - photo.height,
                mounting.pitch_radians - math.radians(photo.pitch),
                mounting.roll_radians - math.radians(photo.roll),
            ]
        )
        scores.append(errors / mounting.sigmas)
    assert np.all(np.abs(np.sqrt(np.mean(np.square(scores), axis=0)) - 1.0) < 0.35)


LENSES = [
    ("plumb_bob", (-0.3, 0.1, 0.001, -0.001, 0.0)),
    ("rational_polynomial", (0.1, -0.05, 0.0, 0.0, 0.01, 0.3, -0.02, 0.01)),
    ("equidistant", (-0.02, 0.01, 0.0, 0.0)),
]


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_a_known_lens_leaves_height_pitch_and_roll(
    model: str, distortion: tuple[float, ...], tmp_path: Path
) -> None:
    photo = Photo(
        yaw=20.0, roll=3.0, focal=420.0, noise=3.0, distortion=distortion, distortion_model=model
    )
    path = tmp_path / "camera_info.yaml"
    rows = ", ".join(map(str, photo.intrinsics.camera_matrix.ravel()))
    path.write_text(
        "image_width: 640\nimage_height: 480\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: [{rows}]}}\n"
        f"distortion_model: {model}\ndistortion_coefficients: {{data: {list(distortion)}}}\n"
    )
    calibration = run(photo, tmp_path, CalibrateOptions(SIDE_METRES, intrinsics_path=path))
    assert floor_distance_errors(photo, calibration).max() < 0.005
    assert calibration.height_metres == pytest.approx(photo.height, rel=0.003)
    assert math.degrees(calibration.pitch_radians) == pytest.approx(photo.pitch, abs=0.05)
    assert calibration.distortion_model == model


def camera_of(mounting: calibrate.Mounting, photo: Photo, *, known: bool) -> Calibration:
    intrinsics = photo.intrinsics if known else None
    return calibrate.make_calibration(mounting, photo.size, intrinsics, None)


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    ("pitch", "roll"),
    [(90, 0), (88, 0), (88, 90), (88, 180), (88, -90), (75, 3), (105, -2), (110, 0)],
)
def test_from_about_straight_above_lengths_on_the_whole_floor_are_right(
    pitch: float, roll: float, known: bool
) -> None:
    centre = (0.6 / math.tan(math.radians(pitch)), 0.01)
    photo = Photo(pitch=pitch, roll=roll, height=0.6, centre=centre, yaw=10.0)
    generator = np.random.default_rng(0)
    noisy = photo.corners + generator.normal(scale=0.05, size=(4, 2))
    mounting = solve(photo, noisy, 0.05, known=known)
    calibration = camera_of(mounting, photo, known=known)
    assert floor_distance_errors(photo, calibration).max() < 0.01
    # Ahead is the picture's up.
    middle, above = (320.0, 240.0), (320.0, 140.0)
    ahead = np.diff(apply_homography(calibration.robot_from_image, [middle, above]), axis=0)[0]
    assert ahead[0] > 0.1
    assert abs(ahead[1]) < 0.01
    assert abs(mounting.height_metres - 0.6) < 3 * mounting.sigmas[1]
    if known:
        assert mounting.height_metres == pytest.approx(0.6, rel=0.003)
        down = math.sin(mounting.pitch_radians) * math.cos(mounting.roll_radians)
        assert math.degrees(math.acos(min(down, 1.0))) == pytest.approx(abs(90 - pitch), abs=0.2)


def test_straight_above_the_focal_length_stays_at_its_prior_with_an_honest_sigma() -> None:
    photo = Photo(pitch=89.0, height=0.6, centre=(0.02, 0.0), yaw=10.0)
    mounting = solve(photo, photo.corners, 0.1, known=False)
    assert mounting.focal_assumed
    assert mounting.sigmas[0] / mounting.focal_pixels == pytest.approx(0.35, rel=0.05)
    assert mounting.sigmas[1] / mounting.height_metres == pytest.approx(0.35, rel=0.05)
    # What of it is common to height and focal length does not change lengths on the floor.
    lengths = mounting.covariance[0, 0] + mounting.covariance[1, 1] - 2 * mounting.covariance[0, 1]
    assert math.sqrt(lengths) < 0.005
    assert not solve(Photo(), Photo().corners, 0.1, known=False).focal_assumed


def test_straight_above_the_photos_own_note_gives_the_focal_length(tmp_path: Path) -> None:
    photo = Photo(pitch=90.0, height=0.6, centre=(0.02, 0.0), yaw=10.0)
    path = tmp_path / "photo.jpg"
    # 560 px of a diagonal of 800 px are 30.3 mm of 43.3 mm.
    write_photo(path, render(photo), exif_of(focal_35mm=30))
    corners = tuple((float(x), float(y)) for x, y in photo.corners)
    run_calibrate(
        [path],
        tmp_path / "out.yaml",
        CalibrateOptions(SIDE_METRES, corners=corners),
        overwrite=False,
    )
    calibration = load_calibration(tmp_path / "out.yaml")
    assert calibration.height_metres == pytest.approx(0.6, rel=0.02)
    assert calibration.focal_sigma_pixels / calibration.camera_matrix[0, 0] < 0.06


@pytest.mark.parametrize(
    ("ahead", "direction"),
    [("up", (0, -1)), ("right", (1, 0)), ("down", (0, 1)), ("left", (-1, 0))],
)
def test_the_direction_ahead_may_be_given(
    ahead: str, direction: tuple[int, int], tmp_path: Path
) -> None:
    photo = Photo(pitch=88.0, roll=30.0, height=0.6, centre=(0.0, 0.0), yaw=10.0)
    corners = tuple((float(x), float(y)) for x, y in photo.corners)
    options = CalibrateOptions(SIDE_METRES, corners=corners, ahead=ahead)  # type: ignore[arg-type]
    calibration = run(photo, tmp_path, options)
    pixels = np.array([(320.0, 240.0), (320.0, 240.0) + 100 * np.array(direction)])
    step = np.diff(apply_homography(calibration.robot_from_image, pixels), axis=0)[0]
    assert step[0] > 0.1
    assert abs(step[1]) < 0.01


@pytest.mark.parametrize(
    ("roll", "size"), [(180.0, (640, 480)), (90.0, (480, 640)), (-90.0, (480, 640))]
)
def test_a_camera_upside_down_or_on_its_side_calibrates(
    roll: float, size: tuple[int, int], tmp_path: Path
) -> None:
    photo = Photo(roll=roll, size=size, yaw=12.0, noise=2.0)
    calibration = run(photo, tmp_path)
    assert floor_distance_errors(photo, calibration).max() < 0.01
    assert math.degrees(calibration.pitch_radians) == pytest.approx(35.0, abs=0.3)
    assert abs(math.remainder(math.degrees(calibration.roll_radians) - roll, 360.0)) < 0.3


def photo_of_a_board(photo: Photo, field_metres: float) -> calibrate.FloorPoints:
    column, row = np.meshgrid(np.arange(9) - 4, np.arange(7) - 3)
    board_points = field_metres * np.column_stack([column.ravel(), row.ravel()])
    floor = board_points @ rotation(photo.yaw).T + photo.centre
    pixels = distort_points(photo.intrinsics, apply_homography(photo.image_from_robot, floor))
    pixels += np.random.default_rng(1).normal(scale=0.02, size=pixels.shape)
    return calibrate.FloorPoints(board_points, pixels, np.eye(pixels.size) * 0.02**2)


def board_photo(pitch: float) -> Photo:
    centre = (0.42, 0.0) if pitch < 90 else (0.0, 0.0)
    return Photo(
        pitch=pitch, yaw=12.0, height=0.45, centre=centre, distortion=(-0.15, 0.04, 0.0, 0.0, 0.0)
    )


@pytest.mark.parametrize("pitch", [35.0, 90.0])
def test_a_chessboard_shows_the_lens_too(pitch: float) -> None:
    photo = board_photo(pitch)
    mounting = calibrate.solve_mounting(photo_of_a_board(photo, 0.045), photo.size)
    assert floor_distance_errors(photo, camera_of(mounting, photo, known=False)).max() < 0.005
    assert mounting.radial[0] < 0 < mounting.radial_sigmas[0]
    if pitch < 90:
        assert mounting.radial[0] == pytest.approx(-0.15, abs=3 * mounting.radial_sigmas[0])
        assert mounting.focal_pixels == pytest.approx(560.0, rel=0.005)


@pytest.mark.parametrize(("field_metres", "shown"), [(0.045, True), (0.015, False)])
def test_how_far_a_chessboard_shows_the_lens_is_known(field_metres: float, shown: bool) -> None:
    photo = board_photo(35.0)
    mounting = calibrate.solve_mounting(photo_of_a_board(photo, field_metres), photo.size)
    calibration = calibrate.make_calibration(mounting, photo.size, None, None)
    sigma = calibrate.lens_sigma(mounting, calibration)
    assert (0.0 < sigma < 0.01) == shown
    floor = seen_floor(calibration)
    pixels = distort_points(calibration, apply_homography(calibration.image_from_robot, floor))
    true = apply_homography(
        np.linalg.inv(photo.image_from_robot), undistort_points(photo.intrinsics, pixels)
    )
    errors = np.linalg.norm(floor - true, axis=1) / np.hypot(
        np.linalg.norm(true, axis=1), photo.height
    )
    assert 0.1 * sigma < errors.max() < 3.0 * sigma


def test_corners_that_no_floor_shows_are_refused() -> None:
    # A square that reaches past the horizon.
    target = calibrate.square_target(1.0)
    pixels = np.array([(300.0, 0.0), (340.0, 0.0), (640.0, 480.0), (320.0, 10.0)])
    points = calibrate.FloorPoints(target, pixels, np.eye(8))
    with pytest.raises(CalibrationError, match="above the floor"):
        calibrate.solve_mounting_with_intrinsics(points, Photo().intrinsics)


def test_corners_may_come_in_any_order() -> None:
    photo = Photo(yaw=33.0, roll=-3.0)
    generator = np.random.default_rng(2)
    first = solve(photo, photo.corners, 0.1, known=False)
    for _ in range(5):
        other = solve(photo, generator.permutation(photo.corners), 0.1, known=False)
        assert other.height_metres == pytest.approx(first.height_metres, rel=1e-9)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([(0, 0), (100, 100), (200, 200), (300, 300)], "line"),
        ([(10, 10), (200, 10), (200, 100), (105, 10)], "line"),
        ([(10, 10), (10, 10), (200, 100), (10, 100)], "same point"),
        ([(10, 10), (200, 10), (110, 40), (100, 200)], "inside the others"),
        ([(10, 10), (900, 10), (200, 100), (10, 100)], "inside the photo"),
        ([(10, 10), (200, 10), (200, 100)], "four points"),
        ([(10, 10), (200, 10), (200, 100), (math.nan, 5)], "four points"),
    ],
)
def test_impossible_corners_are_refused(corners: list[tuple[float, float]], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        calibrate.sort_corners(corners, (640, 480))


# Of a chessboard's field in the square that it is printed on.
FIELD_SHARE = 44 / 500


@cache
def chessboard_sheet() -> np.ndarray:
    fields = np.indices((7, 9)).sum(axis=0) % 2
    board = np.kron(fields, np.ones((44, 44), int)) * 255
    return np.pad(board, ((96, 96), (52, 52)), constant_values=255)


@cache
def marker_sheet() -> np.ndarray:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return np.pad(
        np.asarray(cv2.aruco.generateImageMarker(dictionary, 7, 300)), 50, constant_values=255
    )


def test_a_chessboard_calibrates(tmp_path: Path) -> None:
    photo = Photo(yaw=12.0, roll=2.0, noise=2.0, sheet=chessboard_sheet())
    calibration = run(
        photo, tmp_path, CalibrateOptions(SIDE_METRES * FIELD_SHARE, chessboard=(8, 6))
    )
    assert floor_distance_errors(photo, calibration).max() < 0.01
    assert calibration.height_metres == pytest.approx(photo.height, rel=0.01)


def test_a_board_whose_fields_were_counted_is_said_to_have_fewer_corners(tmp_path: Path) -> None:
    photo = Photo(yaw=12.0, sheet=chessboard_sheet())
    with pytest.raises(CalibrationError, match="--chessboard 8x6"):
        run(photo, tmp_path, CalibrateOptions(0.03, chessboard=(9, 7)))


def test_crossings_are_found_to_a_fiftieth_of_a_pixel_however_small_the_fields() -> None:
    for photo in (
        Photo(yaw=12.0, roll=2.0, noise=2.0, blur=0.7, sharpening=0.5, sheet=chessboard_sheet()),
        Photo(yaw=12.0, centre=(0.65, 0.0), noise=1.0, blur=0.7, sheet=chessboard_sheet()),
    ):
        target, pixels, covariance = board.find_chessboard(render(photo), 8, 6, FIELD_SHARE)
        points = calibrate.FloorPoints(target * photo.side, pixels, covariance)
        mounting = calibrate.solve_mounting(points, photo.size)
        grid = (target - target.mean(axis=0)) * photo.side
        errors = []
        for turn in range(4):
            floor = grid @ rotation(photo.yaw + 90.0 * turn).T + photo.centre
            seen = apply_homography(photo.image_from_robot, floor)
            errors.append(np.linalg.norm(seen - pixels, axis=1))
        best = min(errors, key=lambda error: float(error.max()))
        assert np.median(best) < 0.02
        assert best.max() < 0.1
        assert mounting.height_metres == pytest.approx(photo.height, rel=0.003)


def test_an_aruco_marker_calibrates(tmp_path: Path) -> None:
    photo = Photo(yaw=-25.0, roll=2.0, noise=2.0, sheet=marker_sheet())
    side = SIDE_METRES * 300 / 400
    calibration = run(photo, tmp_path, CalibrateOptions(side, marker="4x4_50"))
    assert floor_distance_errors(photo, calibration).max() < 0.02
    assert calibration.height_metres == pytest.approx(photo.height, rel=0.02)


def test_the_command_writes_a_calibration_and_a_check_picture(tmp_path: Path) -> None:
    photo = Photo(yaw=15.0, noise=3.0)
    picture = save_photo(photo, tmp_path / "Quadrat ä 1.png")
    output = tmp_path / "new folder"
    result = CliRunner().invoke(main, ["calibrate", str(picture), "-o", str(output)])
    assert result.exit_code == 0, result.output
    calibration = load_calibration(output / "calibration.yaml")
    assert calibration.height_metres == pytest.approx(0.3, rel=0.01)
    drawing = cv2.imread(str(output / "calibration.png"))
    assert drawing is not None
    assert "mm of floor" in result.output
    text = (output / "calibration.yaml").read_bytes()
    again = CliRunner().invoke(main, ["calibrate", str(picture), "-o", str(output)])
    assert again.exit_code == 1
    assert "--overwrite" in again.output
    over = CliRunner().invoke(main, ["calibrate", str(picture), "-o", str(output), "--overwrite"])
    assert over.exit_code == 0
    assert (output / "calibration.yaml").read_bytes() == text


def test_the_far_limit_is_chosen_or_given(tmp_path: Path) -> None:
    photo = Photo(pitch=20.0, height=0.2, centre=(0.6, 0.0), noise=2.0)
    chosen = run(photo, tmp_path)
    near = floor_sampling(chosen, [[0.35, 0.0]])[0, 0]
    far = floor_sampling(chosen, [[chosen.max_range_metres, 0.0]])[0, 0]
    assert far / near > 3
    given = run(photo, tmp_path, CalibrateOptions(SIDE_METRES, max_range_metres=0.9))
    assert given.max_range_metres == 0.9


def test_several_photos_are_compared_and_the_best_is_written(tmp_path: Path) -> None:
    pitches = (25.0, 45.0)
    photos = [
        save_photo(
            Photo(pitch=pitch, height=0.35, centre=(0.35 / math.tan(math.radians(pitch)), 0.0)),
            tmp_path / f"pitch{pitch:.0f}.png",
        )
        for pitch in pitches
    ]
    photos.append(tmp_path / "blank.png")
    cv2.imwrite(str(photos[-1]), np.full((480, 640, 3), 80, np.uint8))
    lines = run_calibrate(photos, tmp_path / "all.yaml", SQUARE, overwrite=False).lines
    table = [line for line in lines if line.startswith("pitch")]
    assert "25.0°" in table[0]
    assert "45.0°" in table[1]
    best = next(line for line in lines if line.startswith("best:"))
    assert "resolve" in best
    assert any("blank.png" in line and "no square" in line for line in lines)
    names = {path.name for path in tmp_path.glob("*.yaml")}
    assert names == {"all.yaml", "all_pitch25.yaml", "all_pitch45.yaml"}
    chosen = best.split()[1].removesuffix(",").removesuffix(".png")
    own = load_calibration(tmp_path / f"all_{chosen}.yaml")
    assert load_calibration(tmp_path / "all.yaml").pitch_radians == own.pitch_radians


def test_of_mountings_that_resolve_about_as_much_the_one_with_more_features_is_best() -> None:
    mountings = [(1.0, 10), (0.97, 20), (0.9, 30)]
    results = [SimpleNamespace(resolved_area=area, feature_count=n) for area, n in mountings]
    assert choose_best(results)[0] is results[1]
    assert choose_best(results[::2])[0] is results[0]


def test_a_flat_camera_resolves_a_part_of_the_floor_that_it_keeps(tmp_path: Path) -> None:
    area, resolved = floor_areas(run(Photo(pitch=20.0, height=0.35, centre=(0.9, 0.0)), tmp_path))
    assert 0.01 * area < resolved < 0.5 * area


def notes_of(photo: Photo, folder: Path, options: CalibrateOptions = SQUARE) -> str:
    picture = save_photo(photo, folder / "square.png")
    lines = run_calibrate([picture], folder / "out.yaml", options, overwrite=True).lines
    return "\n".join(line for line in lines if line.startswith("note: "))


def test_sides_that_a_lens_bends_are_reported(tmp_path: Path) -> None:
    bent = Photo(focal=420.0, centre=(0.45, 0.0), distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))
    assert "sides bend by up to" in notes_of(bent, tmp_path)
    assert "bend" not in notes_of(Photo(), tmp_path)


def test_corners_that_are_not_those_of_a_square_are_reported(tmp_path: Path) -> None:
    photo = Photo(focal=560.0)
    corners = [(float(x), float(y)) for x, y in photo.corners]
    wrong = [corners[0], corners[1], corners[2], (corners[3][0], corners[3][1] + 10.0)]
    for given, noted in ((corners, False), (wrong, True)):
        options = CalibrateOptions(SIDE_METRES, corners=tuple(given), refine=False)
        assert ("fits a flat floor only to" in notes_of(photo, tmp_path, options)) == noted


def test_corners_read_coarsely_are_moved_to_the_pictures_edges(tmp_path: Path) -> None:
    photo = Photo(focal=560.0)
    corners = [(float(x), float(y)) for x, y in photo.corners]
    coarse = [(corners[0][0] + 2.0, corners[0][1] + 3.0), *corners[1:]]
    for given, moved in ((corners, False), (coarse, True)):
        options = CalibrateOptions(SIDE_METRES, corners=tuple(given))
        assert ("the given corners are moved" in notes_of(photo, tmp_path, options)) == moved
        found = load_calibration(tmp_path / "out.yaml")
        assert found.height_metres == pytest.approx(photo.height, rel=2e-3)
    assert not notes_of(photo, tmp_path, replace(options, refine=False))
    found = load_calibration(tmp_path / "out.yaml")
    assert found.height_metres != pytest.approx(photo.height, rel=2e-3)


def blank_photo(folder: Path) -> Path:
    path = folder / "photo.png"
    cv2.imwrite(str(path), np.full((480, 640, 3), 80, np.uint8))
    return path


def test_bad_input_is_one_line_and_writes_nothing(tmp_path: Path) -> None:
    photo = blank_photo(tmp_path)
    output = tmp_path / "out.yaml"
    corners = ((100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0))
    lens = tmp_path / "lens.yaml"
    save_calibration(lens, top_down_calibration((320, 240)))
    text = tmp_path / "text.png"
    text.write_text("no picture")
    cases: list[tuple[Path, CalibrateOptions, type[Exception], str]] = [
        (tmp_path / "none.png", SQUARE, InputError, "none.png"),
        (text, SQUARE, InputError, "text.png"),
        (photo, SQUARE, CalibrationError, "--corners"),
        (photo, CalibrateOptions(0.0), InputError, "--side"),
        (photo, CalibrateOptions(-0.3), InputError, "--side"),
        (photo, CalibrateOptions(0.3, max_range_metres=0.0), InputError, "--max-range"),
        (photo, CalibrateOptions(0.3, corners=corners, marker="4x4_50"), InputError, "only one"),
        (photo, CalibrateOptions(0.3, refine=True), InputError, "--refine"),
        (photo, CalibrateOptions(0.3, chessboard=(7, 5)), CalibrationError, "chessboard"),
        (photo, CalibrateOptions(0.3, marker="4x4_50"), CalibrationError, "marker"),
        (photo, CalibrateOptions(0.3, marker="9x9"), CalibrationError, "dictionary"),
        (photo, CalibrateOptions(0.3, intrinsics_path=lens), CalibrationError, "320x240"),
    ]
    for path, options, kind, message in cases:
        with pytest.raises(kind, match=message) as caught:
            run_calibrate([path], output, options, overwrite=False)
        assert "\n" not in str(caught.value)
    assert not output.exists()
    output.write_text("mine")
    with pytest.raises(OutputError, match="--overwrite"):
        run_calibrate([photo], output, SQUARE, overwrite=False)
    assert output.read_text() == "mine"


def test_a_malformed_option_is_a_usage_error(tmp_path: Path) -> None:
    photo = str(blank_photo(tmp_path))
    for option in (
        ["--gamma", "rec709"],
        ["--gamma", "0"],
        ["--corners", "1,2 3,4"],
        ["--corners", "a,b c,d e,f g,h"],
        ["--chessboard", "8"],
    ):
        assert CliRunner().invoke(main, ["calibrate", photo, *option]).exit_code == 2
