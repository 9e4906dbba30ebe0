"""Registration by the pixels: floors on which features find little, or too much alike."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import slamcli
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions, MatchOptions
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.records import FeatureAlignment, Features, Frame, PreparedFrame
from slamcli.registration import register
from slamcli.registration.hypothesis import PyramidPair, score_refined
from slamcli.registration.refinement import refine_hypothesis
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions
from slamcli.stages import align, dense

CAMERA = CameraOptions(size=(400, 300))
CALIBRATION = photograph.make_camera(CAMERA)


def photographer_of(floor: floors.Floor) -> photograph.Photographer:
    return photograph.Photographer(photograph.World(floor), CALIBRATION)


def bare_course() -> photograph.Photographer:
    return photographer_of(floors.make_floor("course", FloorOptions(wear=0.0), 0.001, seed=0))


def prepared_of(
    photographer: photograph.Photographer,
    pose: Pose2,
    index: int,
    disturbances: DisturbanceOptions | None = None,
) -> PreparedFrame:
    generator = np.random.default_rng(index)
    image = photograph.take(
        photographer, (pose, pose), 0.0, disturbances or DisturbanceOptions(), generator
    )
    return slamcli.Mapper(CALIBRATION).prepare(Frame(index, f"{index}", None, image))


def error_of(measured: Pose2, truth: Pose2) -> tuple[float, float]:
    error = truth.inverse() @ measured
    return error.translation_length, abs(math.degrees(error.theta))


def on_circle(angle: float) -> Pose2:
    return Pose2(-0.45 + 0.38 * math.sin(angle), -0.07 - 0.38 * math.cos(angle), angle)


def stripes(period_metres: float, *, both: bool) -> floors.BlockFloor:
    """Return white lines on black every so often, across x, or also along it: a tiled floor."""

    def paint(grid: slamcli.Grid) -> np.ndarray:
        column, row = np.arange(grid.width), np.arange(grid.height)
        x = grid.x_min + grid.metres_per_pixel * column
        y = grid.y_max - grid.metres_per_pixel * row
        lines = np.broadcast_to((x % period_metres < 0.012)[None, :], (grid.height, grid.width))
        if both:
            lines = lines | (y % period_metres < 0.012)[:, None]
        gray = np.where(lines, np.uint8(220), np.uint8(40))
        return np.ascontiguousarray(np.repeat(gray[..., None], 3, axis=2))

    return floors.BlockFloor(paint, 0.001)


@pytest.mark.parametrize("degrees", [0.0, 2.0, 11.0, -27.0])
def test_a_search_finds_the_motion_between_views_of_bare_lines(degrees: float) -> None:
    camera = bare_course()
    start = on_circle(0.3)
    motion = Pose2(0.06, 0.01, math.radians(degrees))
    a, b = prepared_of(camera, start, 0), prepared_of(camera, start @ motion, 1)
    found = dense.search(a.levels[-1], b.levels[-1], dense.SearchWindow(), min_overlap=0.1)
    metres, turned = error_of(found.candidates[0].a_from_b, motion)
    assert metres < 4.0 * a.levels[-1].metres_per_pixel
    assert turned <= 2.5
    assert found.candidates[0].correlation > 0.7


def test_a_search_looks_within_its_window_alone() -> None:
    camera = bare_course()
    start, motion = on_circle(0.3), Pose2(0.10, 0.0, 0.1)
    a, b = prepared_of(camera, start, 0), prepared_of(camera, start @ motion, 1)
    window = dense.SearchWindow(Pose2(0.30, 0.0, 0.1), math.radians(8), 0.1)
    for candidate in dense.search(a.levels[-1], b.levels[-1], window, min_overlap=0.1).candidates:
        middle = np.array([[0.4, 0.0]])
        apart = candidate.a_from_b.apply(middle) - window.centre.apply(middle)
        assert np.linalg.norm(apart) < 0.14


@pytest.mark.slow
def test_the_textureless_course_is_mapped_whole() -> None:
    """ORB and a similarity place hardly a frame of it."""
    camera, mapper = bare_course(), slamcli.Mapper(CALIBRATION)
    truth = [on_circle(angle) for angle in np.linspace(0.0, math.tau, 60, endpoint=False)]
    for index, pose in enumerate(truth):
        mapper.step(prepared_of(camera, pose, index))
    estimates = mapper.finish()
    assert sum(e.map_from_robot is not None for e in estimates) >= 59
    placed = [e for e in estimates if e.map_from_robot is not None]
    for before, after in pairwise(placed):
        if before.fragment != after.fragment:
            continue
        assert before.map_from_robot is not None
        assert after.map_from_robot is not None
        step = before.map_from_robot.inverse() @ after.map_from_robot
        true = truth[before.index].inverse() @ truth[after.index]
        metres, degrees = error_of(step, true)
        assert metres < 0.012
        assert degrees < 1.0


def test_tiles_that_are_all_alike_are_ambiguous() -> None:
    camera = photographer_of(stripes(0.1, both=True))
    a, b = prepared_of(camera, Pose2(), 0), prepared_of(camera, Pose2(0.03, 0.01, 0.02), 1)
    result = register(a, b, None, CALIBRATION, MapperOptions(), window=dense.SearchWindow())
    assert result.link is None
    assert "ambiguous" in result.reason or "open along" in result.reason


def prior_of(motion: Pose2 | None) -> dense.MotionPrior | None:
    return None if motion is None else dense.MotionPrior(motion, np.eye(3))


def test_an_expected_motion_saves_work_and_is_no_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    motion = Pose2(0.06, 0.01, 0.05)
    guesses: list[Pose2 | None] = []
    plain = align.align

    def noted(
        a: Features, b: Features, matching: MatchOptions, guess: Pose2 | None
    ) -> FeatureAlignment:
        guesses.append(guess)
        return plain(a, b, matching, guess)

    monkeypatch.setattr(align, "align", noted)
    camera = photographer_of(floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=3))
    a, b = prepared_of(camera, Pose2(), 0), prepared_of(camera, motion, 1)
    near, wrong = motion @ Pose2(0.02, -0.01, 0.03), motion @ Pose2(-0.4, 0.1)
    links = {}
    for expected, expected_guesses in ((None, [None]), (near, [near]), (wrong, [wrong, None])):
        guesses.clear()
        result = register(a, b, None, CALIBRATION, MapperOptions(), prior=prior_of(expected))
        assert guesses == expected_guesses
        assert result.link is not None
        assert error_of(result.link.a_from_b, motion)[0] < 0.0003
        links[expected] = result.link
    assert links[wrong].a_from_b == links[None].a_from_b
    tiles = photographer_of(stripes(0.1, both=True))
    a, b = prepared_of(tiles, Pose2(), 0), prepared_of(tiles, motion, 1)
    guesses.clear()
    assert register(a, b, None, CALIBRATION, MapperOptions(), prior=prior_of(motion)).link is None
    assert guesses == [None]


def test_a_single_line_leaves_the_motion_along_it_open() -> None:
    camera = photographer_of(stripes(5.0, both=False))
    start = Pose2(-0.5, 0.0, 0.0)
    a, b = prepared_of(camera, start, 0), prepared_of(camera, start @ Pose2(0.04, 0.02), 1)
    result = register(a, b, None, CALIBRATION, MapperOptions(), window=dense.SearchWindow())
    assert result.link is None
    refined = dense.refine(a.levels, b.levels, Pose2(0.04, 0.02), CALIBRATION, 0.0)
    if refined is not None:
        across, along = np.sqrt(np.diag(refined.covariance)[:2])
        assert along > 10 * across


def test_a_refinement_models_a_rocking_camera() -> None:
    camera = photographer_of(floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=3))
    rocking = DisturbanceOptions(rocking_degrees=0.4, bounce_metres=0.002)
    motion = Pose2(0.05, 0.01, 0.1)
    a = prepared_of(camera, Pose2(), 10, rocking)
    b = prepared_of(camera, motion, 11, rocking)
    tilt = math.radians(0.4)
    rigid = dense.refine(a.levels, b.levels, motion, CALIBRATION, 0.0)
    rocked = dense.refine(a.levels, b.levels, motion, CALIBRATION, tilt)
    assert rigid is not None
    assert rocked is not None
    metres, degrees = error_of(rocked.a_from_b, motion)
    assert metres < 0.0015
    assert degrees < 0.15
    finest = a.levels[0], b.levels[0]
    plain = dense.agreement(*finest, rigid.view_a_from_view_b).correlation
    assert dense.agreement(*finest, rocked.view_a_from_view_b).correlation > plain + 0.1


def test_the_errors_of_measured_motions_are_what_their_covariances_say() -> None:
    """Of motions by the pixels, and by features alone."""
    camera = photographer_of(floors.make_floor("concrete", FloorOptions(wear=0.0), 0.001, seed=5))
    normalised: dict[str, list[float]] = {"pixels": [], "features": []}
    for index in range(16):
        motion = Pose2(0.04, 0.005 * (index % 8), 0.03 * (index % 8))
        start = Pose2(0.3 * index, 0.0, 0.0)
        a = prepared_of(camera, start, 2 * index)
        b = prepared_of(camera, start @ motion, 2 * index + 1)
        refined = dense.refine(a.levels, b.levels, motion, CALIBRATION, 0.0)
        matched = align.align(a.features, b.features, MapperOptions().matching)
        assert refined is not None
        for kind, found, covariance in (
            ("pixels", refined.a_from_b, refined.covariance),
            ("features", matched.pose, matched.covariance),
        ):
            error = motion.inverse() @ found
            vector = np.array([error.x, error.y, error.theta])
            normalised[kind].append(float(vector @ np.linalg.solve(covariance, vector)))
    # Three degrees of freedom: the 95 % band of the mean of eight.
    for squares in normalised.values():
        assert 1.6 < np.mean(squares) < 4.9
        assert max(squares) < 20.0


def test_floor_elsewhere_is_not_placed() -> None:
    camera = photographer_of(floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=3))
    a, b = prepared_of(camera, Pose2(), 0), prepared_of(camera, Pose2(9.0, 4.0, 1.0), 1)
    result = register(a, b, None, CALIBRATION, MapperOptions(), window=dense.SearchWindow())
    assert result.link is None
    assert result.reason


def test_vignetting_does_not_bias_the_motion_of_a_line() -> None:
    """A lens darkens where a line is seen, not where it lies."""
    camera = bare_course()
    start, motion = on_circle(0.3), Pose2(0.05, 0.0, 0.08)
    dark = DisturbanceOptions(vignetting=0.4, noise_gray=1.0)
    a, b = prepared_of(camera, start, 0, dark), prepared_of(camera, start @ motion, 1, dark)
    result = register(a, b, None, CALIBRATION, MapperOptions(), window=dense.SearchWindow())
    assert result.link is not None
    metres, degrees = error_of(result.link.a_from_b, motion)
    assert metres < 0.003
    assert degrees < 0.3


def bare_pair(disturbances: DisturbanceOptions) -> tuple[PreparedFrame, PreparedFrame, Pose2]:
    """Return two frames of a bare floor with a few marks, and the motion between them."""
    photographer = photographer_of(floors.make_floor("bare", FloorOptions(wear=0.5), 0.001, seed=0))
    start, motion = Pose2(0.2, 0.1, 0.3), Pose2(0.05, 0.01, 0.04)
    first = prepared_of(photographer, start, 0, disturbances)
    return first, prepared_of(photographer, start @ motion, 1, disturbances), motion


def test_noise_hides_no_mark_on_a_bare_floor() -> None:
    a, b, motion = bare_pair(DisturbanceOptions(noise_gray=12.0))
    result = register(a, b, None, CALIBRATION, MapperOptions(), window=dense.SearchWindow())
    assert result.link is not None, result.reason
    metres, degrees = error_of(result.link.a_from_b, motion)
    assert metres < 0.002
    assert degrees < 0.2


def test_points_on_obstacles_are_left_out_of_the_levels_that_are_refined() -> None:
    a, b, motion = bare_pair(DisturbanceOptions())
    image = b.levels[0].image.copy()
    image[:, : image.shape[1] // 2] = np.random.default_rng(0).integers(0, 255, image.shape)[
        :, : image.shape[1] // 2
    ]
    obstructed = replace(b.levels[0], image=image)
    kept = dense.keep_agreeing_points(a.levels[:2], obstructed, motion.matrix)
    pixels = apply_homography(b.levels[0].pixel_from_metres, motion.inverse().apply(kept[0].points))
    assert 0 < len(kept[0].points) < len(a.levels[0].points)
    assert pixels[:, 0].min() > image.shape[1] // 2 - 16


def test_all_of_the_floor_is_used_once_rocking_explains_why_it_disagreed() -> None:
    # By the few patches that agree without rocking, the motion comes out 5 mm and 0.3 degrees off.
    calibration = photograph.make_camera(CameraOptions(size=(640, 480)))
    world = photograph.World(floors.make_floor("carpet", FloorOptions(wear=0.5), 0.001, seed=0))
    photographer = photograph.Photographer(world, calibration)
    mapper, motion = slamcli.Mapper(calibration), Pose2(0.08, 0.01, 0.08)
    poses = [Pose2()]
    for _ in range(6):
        poses.append(poses[-1] @ motion)
    prepared = []
    for index in (5, 6):
        way, generator = (poses[index], poses[index]), np.random.default_rng(index)
        rocking = DisturbanceOptions(rocking_degrees=0.5)
        image = photograph.take(photographer, way, 0.0, rocking, generator)
        prepared.append(mapper.prepare(Frame(index, f"{index}", None, image)))
    result = register(*prepared, None, calibration, MapperOptions())
    assert result.link is not None
    metres, degrees = error_of(result.link.a_from_b, motion)
    assert metres < 0.0005
    assert degrees < 0.03


ROCKED_MOTION = Pose2(0.05, 0.01, 0.08)


def rocked_pair(
    floor: str, degrees: float, place: int
) -> tuple[Calibration, PreparedFrame, PreparedFrame]:
    """Return the camera and two frames `ROCKED_MOTION` apart, each with a tilt of its own."""
    calibration = photograph.make_camera(CameraOptions())
    world = photograph.World(floors.make_floor(floor, FloorOptions(wear=0.5), 0.001, seed=0))
    photographer = photograph.Photographer(world, calibration)
    mapper, rocking = slamcli.Mapper(calibration), DisturbanceOptions(rocking_degrees=degrees)
    start, prepared = Pose2(0.2 * place), []
    for index, pose in enumerate((start, start @ ROCKED_MOTION)):
        generator = np.random.default_rng([place, index])
        image = photograph.take(photographer, (pose, pose), 0.0, rocking, generator)
        prepared.append(mapper.prepare(Frame(index, f"{index}", None, image)))
    return calibration, prepared[0], prepared[1]


@pytest.mark.parametrize(("floor", "place"), [("asphalt", 2), ("planks", 1)])
def test_rocking_is_suspected_where_a_steady_fit_correlates_well(floor: str, place: int) -> None:
    calibration, a, b = rocked_pair(floor, 0.1, place)
    suspected = math.radians(0.1)
    levels = a.levels[:2], b.levels[:2]
    steady = dense.refine(
        *levels,
        ROCKED_MOTION,
        calibration,
        0.0,
        dense.RefinementAssumptions(suspected_tilt_radians=suspected),
    )
    assert steady is not None
    assert steady.rocking_suspected
    metres, _ = error_of(steady.a_from_b, ROCKED_MOTION)
    assert metres > 0.0007
    near = PyramidPair(a.levels, b.levels)
    assert score_refined(near, steady).correlation > 0.95
    result = register(a, b, None, calibration, MapperOptions())
    assert result.link is not None
    metres, _ = error_of(result.link.a_from_b, ROCKED_MOTION)
    assert metres < 0.0003


@pytest.mark.parametrize("floor", ["asphalt", "course"])
def test_a_steady_camera_is_not_suspected_to_rock(floor: str) -> None:
    calibration, a, b = rocked_pair(floor, 0.0, 0)
    levels, suspected = (a.levels[:2], b.levels[:2]), math.radians(0.1)
    steady = dense.refine(
        *levels,
        ROCKED_MOTION,
        calibration,
        0.0,
        dense.RefinementAssumptions(suspected_tilt_radians=suspected),
    )
    assert steady is not None
    assert not steady.rocking_suspected


@pytest.mark.parametrize("place", [1, 2])
def test_a_camera_may_rock_by_more_than_its_tilt_sigma(place: int) -> None:
    """With the tilt sigma alone, the motions come out 0.16 to 0.37 mm off."""
    calibration, a, b = rocked_pair("carpet", 0.5, place)
    result = register(a, b, None, calibration, MapperOptions())
    assert result.link is not None
    metres, _ = error_of(result.link.a_from_b, ROCKED_MOTION)
    assert metres < 0.00012


def test_rocking_leaves_a_motion_over_lines_as_uncertain_as_it_is() -> None:
    """What tilt and motion have in common was taken for aliasing: one sigma of 580 mm."""
    calibration, a, b = rocked_pair("course", 0.5, 1)
    levels = a.levels[:2], b.levels[:2]
    refined = dense.refine(*levels, ROCKED_MOTION, calibration, math.radians(0.5))
    assert refined is not None
    metres, _ = error_of(refined.a_from_b, ROCKED_MOTION)
    assert metres < 0.0008
    for covariance in (refined.covariance, refined.predicted_covariance):
        assert 0.0005 < math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[1]) < 0.002
    narrow, wide = np.sqrt(np.linalg.eigvalsh(refined.covariance[:2, :2]))
    assert narrow > 0.1 * wide


def test_much_rocking_is_found_from_a_fit_with_less_of_it() -> None:
    """Features start 10 mm off, where few patches agree; from there it comes out 0.4 mm off."""
    calibration, a, b = rocked_pair("carpet", 0.5, 3)
    options = MapperOptions()
    found = align.align(a.features, b.features, options.matching)
    assert found.pose is not None
    near = PyramidPair(a.levels, b.levels)
    fit = refine_hypothesis(near, found.pose, found.covariance, calibration, options)
    assert fit is not None
    metres, _ = error_of(fit.pose, ROCKED_MOTION)
    assert metres < 0.00025


def test_disagreement_from_rocking_does_not_make_another_tile_win() -> None:
    """Features alone, not yet allowed to rock, agree with few patches: the search's fit is kept."""
    calibration = photograph.make_camera(CameraOptions())
    world = photograph.World(floors.make_floor("tiles", FloorOptions(wear=0.5), 0.0005, seed=0))
    photographer = photograph.Photographer(world, calibration)
    mapper = slamcli.Mapper(calibration)
    rocking = DisturbanceOptions(rocking_degrees=0.5)
    frames, poses = [], []
    for index in (11, 12):
        angle = index * 0.07 / 1.5
        pose = Pose2(1.5 * math.sin(angle), 1.5 * (1.0 - math.cos(angle)), angle)
        generator = np.random.default_rng([0, 2, index])
        image = photograph.take(photographer, (pose, pose), 0.0, rocking, generator)
        frames.append(mapper.prepare(Frame(index, f"{index}", None, image)))
        poses.append(pose)
    motion = poses[0].inverse() @ poses[1]
    window = dense.SearchWindow(motion, math.radians(40.0), 0.4)
    result = register(frames[0], frames[1], None, calibration, MapperOptions(), window=window)
    assert result.link is not None, result.reason
    metres, degrees = error_of(result.link.a_from_b, motion)
    assert metres < 0.002
    assert degrees < 0.2


def test_the_score_separates_right_motions_from_wrong_ones() -> None:
    camera = photographer_of(floors.make_floor("asphalt", FloorOptions(wear=0.5), 0.001, seed=3))
    motion = Pose2(0.05, 0.01, 0.1)
    a, b = prepared_of(camera, Pose2(), 0), prepared_of(camera, motion, 1)
    elsewhere = prepared_of(camera, Pose2(4.0, 1.0, 0.3), 2)
    window = dense.SearchWindow()
    right = register(a, b, None, CALIBRATION, MapperOptions(), window=window)
    wrong = register(a, elsewhere, None, CALIBRATION, MapperOptions(), window=window)
    assert right.link is not None
    assert right.link.score == right.score
    assert 0.98 < right.score <= 1.0
    assert wrong.link is None
    assert 0.0 <= wrong.score < 0.3
