"""The mapper, on a simulated floor whose truth is known."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from worlds import error_of, make_photographer, take

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, FloorOptions
from slamcli.stages import covisibility

CAMERA = CameraOptions(size=(400, 300), height_metres=0.2, pitch_degrees=45.0)


@pytest.fixture(scope="module")
def photographer() -> photograph.Photographer:
    return make_photographer(camera=CAMERA)


def test_a_drive_is_located_to_a_millimetre(photographer: photograph.Photographer) -> None:
    truth = [Pose2(0.04 * i, 0.004 * i * i, 0.08 * i) for i in range(8)]
    mapper = slamcli.Mapper(photographer.calibration)
    streamed = [mapper.update(take(photographer, pose, i)) for i, pose in enumerate(truth)]
    for estimate, pose in zip(streamed, truth, strict=True):
        metres, degrees = error_of(estimate, pose)
        assert metres < 0.001
        assert degrees < 0.1
    for estimate, pose in zip(mapper.finish(), truth, strict=True):
        assert error_of(estimate, pose)[0] < 0.001
        assert estimate.covariance is not None
        assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0)
    assert all(link.score > 0.8 for link in mapper.links)


def test_a_third_keyframe_is_used_only_where_it_overlaps_much(
    photographer: photograph.Photographer,
) -> None:
    """A rocking camera's views, where they overlap little, bend a motion more than they add."""
    options = slamcli.MapperOptions(keyframe_overlap=0.95)
    mapper = slamcli.Mapper(photographer.calibration, options)
    for i in range(7):
        mapper.update(take(photographer, Pose2(0.06 * i), i))
    footprint = covisibility.Footprint(photographer.calibration)
    shared: dict[int, list[float]] = {}
    for link in mapper.links:
        motion = link.a_from_b
        overlap = footprint.overlaps(np.array([[motion.x, motion.y, motion.theta]]))[0]
        shared.setdefault(link.b, []).append(float(overlap))
    assert max(len(overlaps) for overlaps in shared.values()) > 1
    assert all(overlap > 0.35 for overlaps in shared.values() for overlap in overlaps[2:])


def test_a_frame_that_cannot_be_used_is_lost_and_the_next_is_not(
    photographer: photograph.Photographer,
) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    mapper.update(take(photographer, Pose2()))
    bad = [
        np.zeros((300, 400, 3), np.uint8),
        np.full((300, 400), 255, np.uint8),
        np.zeros((10, 10), np.uint8),
        np.zeros((300, 400, 3)),
        np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8),
        None,
        "frame.png",
    ]
    for picture in bad:
        estimate = mapper.update(picture)  # type: ignore[arg-type]
        assert estimate.status == "lost"
        assert estimate.map_from_robot is None
        assert estimate.reason
        assert "\n" not in estimate.reason
    metres, _ = error_of(mapper.update(take(photographer, Pose2(0.05), 1)), Pose2(0.05))
    assert metres < 0.001


def test_the_same_picture_again_has_the_same_pose(
    photographer: photograph.Photographer,
) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    mapper.update(take(photographer, Pose2()))
    picture = take(photographer, Pose2(0.05), 1)
    first, again = mapper.update(picture), mapper.update(picture.copy())
    assert again.map_from_robot == first.map_from_robot
    assert again.status == "tracked"
    assert "same picture as frame 1" in again.reason


def test_a_break_starts_a_map_of_its_own_and_floor_seen_before_joins_them(
    photographer: photograph.Photographer,
) -> None:
    away = [Pose2(5.0 + 0.05 * i, 2.0, 0.5) for i in range(3)]
    mapper = slamcli.Mapper(photographer.calibration)
    mapper.update(take(photographer, Pose2()))
    mapper.update(take(photographer, Pose2(0.05), 1))
    assert mapper.update(take(photographer, away[0], 2)).status == "lost"
    joined = mapper.update(take(photographer, away[1], 3))
    assert joined.status == "tracked"
    assert joined.revised == (2,)
    apart = mapper.finish()
    assert [estimate.fragment for estimate in apart] == [0, 0, 1, 1]
    assert error_of(apart[3], away[0].inverse() @ away[1])[0] < 0.001
    back = mapper.update(take(photographer, Pose2(0.08, 0.01, 0.05), 4))
    assert back.fragment == 0
    assert error_of(back, Pose2(0.08, 0.01, 0.05))[0] < 0.001


def test_frames_that_share_nothing_are_not_placed_by_guess(
    photographer: photograph.Photographer,
) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    for index in range(4):
        mapper.update(take(photographer, Pose2(3.0 * index), index))
    estimates = mapper.finish()
    assert [estimate.status for estimate in estimates] == ["tracked", "lost", "lost", "lost"]


def test_an_index_that_came_before_is_refused(photographer: photograph.Photographer) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    frame = slamcli.Frame(3, "a", None, take(photographer, Pose2()))
    assert mapper.update(frame).status == "tracked"
    refused = mapper.update(frame)
    assert refused.status == "lost"
    assert "came before" in refused.reason
    assert len(mapper.estimates) == 1


@pytest.mark.slow
def test_a_bare_course_is_never_placed_by_its_own_symmetry() -> None:
    """Its lines and squares look the same again after a quarter or a half turn."""
    floor = floors.make_floor("course", FloorOptions(wear=0.0), 0.001, seed=0)
    calibration = photograph.make_camera(CameraOptions(size=(400, 300)))
    bare = photograph.Photographer(photograph.World(floor), calibration)
    angles = np.linspace(0.0, math.tau, 20, endpoint=False)
    truth = [Pose2(-0.45 + 0.38 * math.sin(a), -0.07 - 0.38 * math.cos(a), a) for a in angles]
    mapper = slamcli.Mapper(calibration)
    for index, pose in enumerate(truth):
        mapper.update(take(bare, pose, index))
    first: dict[int, int] = {}
    for estimate in mapper.finish():
        if estimate.map_from_robot is None:
            continue
        origin = first.setdefault(estimate.fragment, estimate.index)
        metres, degrees = error_of(estimate, truth[origin].inverse() @ truth[estimate.index])
        assert metres < 0.05
        assert degrees < 2.0


def test_a_turn_that_no_robot_makes_between_frames_is_rejected(
    photographer: photograph.Photographer,
) -> None:
    mapper = slamcli.Mapper(photographer.calibration)
    mapper.update(take(photographer, Pose2()))
    # Turned by 100 degrees about the middle of what it sees, it shows much of the same floor.
    middle = Pose2(0.25)
    turned = middle @ Pose2(0.0, 0.0, math.radians(100)) @ middle.inverse()
    estimate = mapper.update(take(photographer, turned, 1))
    assert estimate.status == "lost"
    assert "100 degrees" in estimate.reason


def test_a_restored_mapper_expects_the_same_motion(photographer: photograph.Photographer) -> None:
    """Its spread of constant velocity too, which decides what a floor that repeats shows."""
    frames = [take(photographer, Pose2(0.04 * i + 0.001 * i * i), i) for i in range(8)]
    mapper = slamcli.Mapper(photographer.calibration)
    for pixels in frames[:7]:
        mapper.update(pixels)
    state = mapper.state()
    prepared = {
        i: mapper.prepare(slamcli.Frame(i, f"frame {i}", None, frames[i]))
        for i in state.tracking.indices
    }
    restored = slamcli.Mapper(photographer.calibration)
    restored.restore(state, prepared)
    keyframe, last = prepared[max(prepared)], prepared[max(prepared)]
    now = replace(last, index=7)
    ours, theirs = (one._motion_model.prior(keyframe, now) for one in (restored, mapper))
    assert theirs is not None
    assert ours is not None
    assert theirs.covariance[0, 0] < 0.01**2  # learned, not the free motion of a step
    np.testing.assert_array_equal(ours.covariance, theirs.covariance)
    assert ours.a_from_b == theirs.a_from_b


def test_what_moves_with_the_camera_is_no_map(photographer: photograph.Photographer) -> None:
    """A hand before the lens, of a pattern that stays: its frames fit each other, not the floor."""
    generator = np.random.default_rng(5)
    height, width = photographer.calibration.image_size[::-1]
    grain = cv2.GaussianBlur(generator.normal(0.0, 60.0, (height, width)), (0, 0), 2.0)
    hand = np.clip(128.0 + 2.0 * grain, 0.0, 255.0)[..., None].repeat(3, axis=2)
    mapper = slamcli.Mapper(photographer.calibration)
    for i in range(12):
        floor = take(photographer, Pose2(0.04 * i), i)
        noise = generator.normal(0.0, 2.0, (height, width, 3))
        covered = np.clip(hand + noise, 0, 255).astype(np.uint8)
        mapper.update(covered if 4 <= i < 8 else floor)
    estimates = mapper.finish()
    assert [e.index for e in estimates if e.status != "tracked"] == [4, 5, 6, 7]
    assert {e.fragment for e in estimates if e.status == "tracked"} == {0}
    assert all("moves with the camera" in e.reason for e in estimates[4:8])
    for index in (0, 3, 8, 11):
        assert error_of(estimates[index], Pose2(0.04 * index))[0] < 0.002
    # And it goes on from there.
    assert mapper.update(take(photographer, Pose2(0.48), 12)).status == "tracked"
