"""Direct tracking: features for keyframes alone, and pixels that do not prove a motion."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from worlds import error_of, make_photographer, take

import slamcli
from slamcli.core.config import MapperOptions
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, PreparedFrame
from slamcli.mapping import preprocessing
from slamcli.mapping.mapper import Mapper
from slamcli.registration import align, direct
from slamcli.registration.marks import RepeatMarks
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions
from slamcli.stages import dense

CAMERA = CameraOptions(size=(400, 300), height_metres=0.2, pitch_degrees=45.0)
STEP_METRES, TURN_RADIANS = 0.02, 0.02
FRAMES = 16


@pytest.fixture(scope="module")
def photographer() -> photograph.Photographer:
    return make_photographer(camera=CAMERA)


@pytest.fixture(scope="module")
def truth() -> list[Pose2]:
    poses = [Pose2()]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] @ Pose2(STEP_METRES, 0.0, TURN_RADIANS))
    return poses


@pytest.fixture(scope="module")
def pictures(photographer: photograph.Photographer, truth: list[Pose2]) -> list[np.ndarray]:
    return [take(photographer, pose, index) for index, pose in enumerate(truth)]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count the calls of the dear kernels."""
    counted: Counter[str] = Counter()

    def counting(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            counted[name] += 1
            return function(*arguments, **options)

        return call

    features = preprocessing.features
    monkeypatch.setattr(features, "extract", counting("extract", features.extract))
    monkeypatch.setattr(align, "align", counting("align", align.align))
    view = preprocessing.view
    monkeypatch.setattr(view, "make_compared_views", counting("views", view.make_compared_views))
    monkeypatch.setattr(dense, "refine", counting("refine", dense.refine))
    monkeypatch.setattr(dense, "find_periods", counting("periods", dense.find_periods))
    monkeypatch.setattr(cv2, "warpPerspective", counting("warp", cv2.warpPerspective))
    monkeypatch.setattr(cv2, "GaussianBlur", counting("blur", cv2.GaussianBlur))
    return counted


def test_more_levels_track_a_frame_that_lies_farther_from_where_it_is_expected(
    photographer: photograph.Photographer, pictures: list[np.ndarray], truth: list[Pose2]
) -> None:
    preparer = preprocessing.Preprocessor(
        photographer.calibration, MapperOptions(metres_per_pixel=0.0004)
    )
    a, b = (preparer.prepare(Frame(i, str(i), None, pictures[i])) for i in (0, 1))
    assert len(a.levels) == 3
    prior = dense.MotionPrior(truth[1] @ Pose2(0.01, -0.008, 0.03), np.eye(3) * 0.05**2)

    def tracked(levels: int) -> bool:
        start, camera = prior.a_from_b, photographer.calibration
        found = direct.track(a, b, start, camera, MapperOptions(), prior, levels)
        return found is not None

    assert [tracked(levels) for levels in (2, 3)] == [False, True]


def test_only_keyframes_have_features_and_most_frames_take_few_kernels(
    photographer: photograph.Photographer,
    pictures: list[np.ndarray],
    truth: list[Pose2],
    calls: Counter[str],
) -> None:
    mapper = Mapper(photographer.calibration)
    each = []
    for picture in pictures:
        before = Counter(calls)
        mapper.update(picture)
        each.append(calls - before)
    for estimate, pose in zip(mapper.estimates, truth, strict=True):
        assert error_of(estimate, pose)[0] < 0.0002
    # The first frame is a keyframe, and the second has no motion before it to expect.
    with_features = [index for index, counted in enumerate(each) if counted["extract"]]
    keyframes = [frame.index for frame in mapper._database.keyframes]
    assert with_features == sorted({*keyframes, 1})
    assert len(keyframes) < FRAMES / 2
    assert calls["align"] == 1
    tracked = [counted for index, counted in enumerate(each) if index not in with_features]
    assert len(tracked) > FRAMES / 2
    for counted in tracked:
        assert counted["refine"] == 1
        # Of the picture for the agreement, and of its contrast for the correlation.
        assert counted["warp"] == 2
        # The picture and its halves, and the detail and the contrast of the second level alone.
        assert counted["blur"] <= 5
        assert counted["views"] == 0
    assert calls["refine"] <= 2 * FRAMES
    # Of each keyframe, and of the second frame, which is registered without an expected motion.
    assert calls["periods"] <= len(keyframes) + 1


def test_what_is_expected_to_be_needed_is_computed_ahead_and_changes_nothing(
    photographer: photograph.Photographer, pictures: list[np.ndarray], calls: Counter[str]
) -> None:
    mapper, plain = (Mapper(photographer.calibration) for _ in range(2))
    ahead, late = Counter[str](), Counter[str]()
    for index, picture in enumerate(pictures):
        before = Counter(calls)
        prepared = mapper.prepare_ahead(Frame(index, str(index), None, picture))
        ahead += calls - before
        before = Counter(calls)
        mapper.step(prepared)
        late += calls - before
        plain.step(plain.prepare(Frame(index, str(index), None, picture)))
    for one, other in zip(mapper.estimates, plain.estimates, strict=True):
        assert one.map_from_robot == other.map_from_robot
        np.testing.assert_array_equal(one.covariance, other.covariance)
    # Two keyframes and the second frame come before any that is expected.
    assert late["extract"] == 3
    assert ahead["extract"] == len(mapper._database.keyframes) - 2 >= 2
    assert ahead["periods"] == ahead["extract"]
    assert late["periods"] <= 3


def test_a_frame_is_placed_alike_whether_its_pyramids_are_made_before_or_when_needed(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    black = np.zeros_like(pictures[0])
    shown = [*pictures[:6], black, *pictures[7:]]
    lazy, eager = Mapper(photographer.calibration), Mapper(photographer.calibration)
    for index, picture in enumerate(shown):
        frame = Frame(index, str(index), None, picture)
        one, other = lazy.update(frame), eager.step(eager.prepare(frame))
        assert (one.status, one.reason) == (other.status, other.reason)
        assert one.map_from_robot == other.map_from_robot
    assert lazy.estimates[6].status == "lost"
    assert "black" in lazy.estimates[6].reason


@pytest.mark.parametrize(
    ("change", "placed"),
    [
        ({}, True),
        # Expected 3 mm and 20 sigmas off.
        ({"off_metres": 0.003}, False),
        # It shows too much new to be sure that it becomes no keyframe.
        ({"keyframe_overlap": 0.99}, False),
        # The floor looks the same within the expected motion's sigma.
        ({"period_metres": 0.0003}, False),
    ],
)
def test_a_sparse_view_places_what_is_expected_shows_little_new_and_has_no_rival(
    photographer: photograph.Photographer,
    pictures: list[np.ndarray],
    change: dict[str, float],
    placed: bool,
) -> None:
    mapper = Mapper(photographer.calibration)
    first, second = (
        mapper.prepare(Frame(index, str(index), None, picture))
        for index, picture in enumerate(pictures[:2])
    )
    if "period_metres" in change:
        period = np.array([[change["period_metres"], 0.0]])
        first = replace(first, periodicity=Deferred.of(period))
    expected = Pose2(STEP_METRES + change.get("off_metres", 0.0), 0.0, TURN_RADIANS)
    prior = dense.MotionPrior(expected, np.diag([0.00015, 0.00015, 0.002]) ** 2)
    options = MapperOptions(keyframe_overlap=change.get("keyframe_overlap", 0.7))
    sparse = second.sparse.value
    assert sparse is not None
    result = direct.track_sparsely(first, second, sparse, photographer.calibration, options, prior)
    assert (result is not None) == placed
    if result is not None and result.link is not None:
        error = Pose2(STEP_METRES, 0.0, TURN_RADIANS).inverse() @ result.link.a_from_b
        assert error.translation_length < 0.0001
        assert abs(math.degrees(error.theta)) < 0.02


def test_an_old_frame_is_no_step_on_a_floor_that_repeats_without_marks(
    monkeypatch: pytest.MonkeyPatch,
    photographer: photograph.Photographer,
    pictures: list[np.ndarray],
) -> None:
    """Where nothing is known of the motion between, equal places are many."""
    for repeats, supported, steps, placed in (
        (False, False, 9, True),
        (True, True, 9, True),
        (True, False, 9, False),
        # Frames that follow one another are near each other.
        (True, False, 1, True),
    ):
        monkeypatch.setattr(RepeatMarks, "support", lambda *_, value=supported, alone=False: value)
        mapper = Mapper(photographer.calibration, MapperOptions(loops=False))
        first, second = (
            mapper.prepare(Frame(index, str(index), None, picture))
            for index, picture in zip((0, steps), pictures[:2], strict=True)
        )
        if repeats:
            first = replace(first, periodicity=Deferred.of(np.array([[5.0, 0.0]])))
        mapper.step(first)
        estimate = mapper.step(second)
        assert (estimate.status == "tracked") is placed
        if not placed:
            assert "few of its marks" in estimate.reason


def test_a_robot_that_drives_back_is_tracked_by_the_keyframes_that_see_its_floor(
    photographer: photograph.Photographer, calls: Counter[str]
) -> None:
    mapper = Mapper(photographer.calibration)
    way = [0.04 * step for step in (*range(9), *range(7, -1, -1))]
    for index, x in enumerate(way):
        before = Counter(calls)
        estimate = mapper.update(take(photographer, Pose2(x), index))
        assert error_of(estimate, Pose2(x))[0] < 0.0002
        # At the turn it is expected to go on.
        if index >= 12:
            assert (calls - before)["align"] == 0
            assert (calls - before)["extract"] == 0
            assert (calls - before)["refine"] <= 2


def test_features_are_the_same_whenever_they_are_extracted(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    """What runs ahead on other threads may need them before or after the frame is placed."""
    poses = []
    for ahead in (False, True):
        mapper = Mapper(photographer.calibration)
        prepared = [
            mapper.prepare(Frame(index, str(index), None, picture))
            for index, picture in enumerate(pictures)
        ]
        if ahead:
            for frame in reversed(prepared):
                assert frame.features is not None
                assert frame.repeats is not None
        poses.append([mapper.step(frame).map_from_robot for frame in prepared])
    assert poses[0] == poses[1]


def tracked(
    photographer: photograph.Photographer,
    pictures: list[np.ndarray],
    expected: Pose2,
    sigma: float = 0.01,
    change: Callable[[PreparedFrame], PreparedFrame] = lambda frame: frame,
) -> slamcli.registration.RegistrationResult | None:
    mapper = Mapper(photographer.calibration)
    first, second = (
        mapper.prepare(Frame(index, str(index), None, picture))
        for index, picture in enumerate(pictures[:2])
    )
    prior = dense.MotionPrior(expected, np.diag([sigma, sigma, sigma]) ** 2)
    return direct.track(
        change(first), second, expected, photographer.calibration, MapperOptions(), prior
    )


def test_a_motion_is_found_by_pixels_alone(
    photographer: photograph.Photographer, pictures: list[np.ndarray], calls: Counter[str]
) -> None:
    result = tracked(photographer, pictures, Pose2(STEP_METRES + 0.004, 0.004, 0.0))
    assert result is not None
    assert result.link is not None
    error = Pose2(STEP_METRES, 0.0, TURN_RADIANS).inverse() @ result.link.a_from_b
    assert error.translation_length < 0.0001
    assert abs(math.degrees(error.theta)) < 0.02
    assert result.link.score > 0.9
    assert (result.link.inliers, calls["extract"]) == (0, 0)


def test_a_surprising_motion_is_not_accepted(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    assert tracked(photographer, pictures, Pose2(STEP_METRES + 0.004), 0.0005) is None


def test_pixels_that_disagree_prove_nothing(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    hidden = pictures[1].copy()
    hidden[:, 150:] = take(make_photographer(seed=9, camera=CAMERA), Pose2(5.0, 5.0))[:, 150:]
    assert tracked(photographer, [pictures[0], hidden], Pose2(STEP_METRES)) is None


def test_a_floor_that_repeats_proves_nothing_where_its_rival_fits(
    photographer: photograph.Photographer,
    pictures: list[np.ndarray],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A rival as good as the motion, one period of the keyframe on."""
    monkeypatch.setattr(direct.PairContext, "check_rivals", lambda *_: "ambiguous")
    expected = Pose2(STEP_METRES, 0.0, TURN_RADIANS)
    assert tracked(photographer, pictures, expected) is not None

    def repeating(frame: PreparedFrame) -> PreparedFrame:
        return replace(frame, periodicity=Deferred.of(np.array([[0.02, 0.0]])))

    assert tracked(photographer, pictures, expected, change=repeating) is None


def test_noise_along_a_plain_line_is_no_proof_of_a_motion_along_it() -> None:
    """By the noise of the third frame its motion seems to be fixed, to 3 mm."""

    def paint_a_line(grid: slamcli.Grid) -> np.ndarray:
        y = grid.y_max - grid.metres_per_pixel * np.arange(grid.height)
        line = np.broadcast_to((np.abs(y - 0.03) < 0.012)[:, None], (grid.height, grid.width))
        return np.dstack([np.where(line, np.uint8(220), np.uint8(60))] * 3)

    camera = photograph.make_camera(CAMERA)
    floor = floors.BlockFloor(paint_a_line, 0.001)
    photographer = photograph.Photographer(photograph.World(floor), camera)
    mapper, measured, before = (
        Mapper(camera, MapperOptions(metres_per_pixel=0.00126)),
        Pose2(),
        None,
    )
    for i in range(3):
        pose = Pose2(0.03 * i, 0.01 * math.sin(0.3 * i), 0.05 * math.sin(0.3 * i + 1))
        if before is not None:
            step = before.inverse() @ pose
            measured = measured @ Pose2(1.02 * step.x, 1.02 * step.y, step.theta + 0.01)
        before = pose
        mapper.odometry(slamcli.OdometryReading(0.2 * i, measured))
        mapper.update(Frame(i, str(i), 0.2 * i, take(photographer, pose, i)))
    assert {link.kind for link in mapper.links} == {"partial"}
