"""Floor that is seen again: old keyframes in place of new ones, poses as exact as before."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from worlds import CAMERA, error_of, make_photographer, take

import slamcli
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.geometry import Pose2
from slamcli.core.telemetry import OdometryReading
from slamcli.simulation import photograph
from slamcli.stages import covisibility

PASS, STEP_METRES, RATE_HERTZ = 12, 0.02, 10.0


def passes(count: int) -> list[Pose2]:
    """A line, driven on forwards and backwards in turn, a little to the side each time."""
    poses = []
    for run in range(count):
        order = range(PASS) if run % 2 == 0 else reversed(range(PASS))
        poses += [
            Pose2(STEP_METRES * place, 0.003 * run, 0.02 * math.sin(place)) for place in order
        ]
    return poses


@pytest.fixture(scope="module")
def photographer() -> photograph.Photographer:
    return make_photographer()


@pytest.fixture(scope="module")
def pictures(photographer: photograph.Photographer) -> list[np.ndarray]:
    return [take(photographer, pose, index) for index, pose in enumerate(passes(4))]


def keyframes(mapper: slamcli.Mapper) -> list[int]:
    floor_map = mapper.floor_map()
    assert floor_map is not None
    return [keyframe.index for keyframe in floor_map.keyframes]


def test_floor_that_is_known_needs_no_more_keyframes(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    mapper, truth = slamcli.Mapper(photographer.calibration), passes(4)
    for picture in pictures:
        mapper.update(picture)
    assert max(keyframes(mapper)) < PASS
    loops = [link for link in mapper.links if link.kind == "loop"]
    assert {link.b // PASS for link in loops} == {1, 2, 3}
    for link in loops:
        error = (truth[link.a].inverse() @ truth[link.b]).inverse() @ link.a_from_b
        assert error.translation_length < 0.0002
    for estimate in mapper.finish():
        assert error_of(estimate, truth[estimate.index])[0] < 0.0002


def test_floor_seen_the_other_way_round_is_known_too() -> None:
    # Turned about, a camera that looks straight down sees all that it saw.
    looking_down = replace(CAMERA, pitch_degrees=90.0)
    photographer = make_photographer(camera=looking_down)
    along = [Pose2(STEP_METRES * place, 0.0, 0.0) for place in range(20)]
    about = [Pose2(along[-1].x, 0.0, turn) for turn in np.linspace(0.2, math.pi, 15).tolist()]
    back = [Pose2(along[-1].x - STEP_METRES * place, 0.0, math.pi) for place in range(1, 20)]
    truth = [*along, *about, *back]
    mapper = slamcli.Mapper(photographer.calibration)
    for index, pose in enumerate(truth):
        mapper.update(take(photographer, pose, index))
    assert max(keyframes(mapper)) < len(along) + len(about)
    assert len([link for link in mapper.links if link.kind == "loop"]) >= 5
    for estimate in mapper.finish():
        assert error_of(estimate, truth[estimate.index])[0] < 0.0005


def test_views_of_level_outlines_share_what_rectangles_do() -> None:
    calibration = make_photographer(camera=replace(CAMERA, pitch_degrees=90.0)).calibration
    footprint = covisibility.Footprint(calibration)
    width, height = np.ptp(footprint_hull(calibration), axis=0)
    motions = np.array([(0.4 * width, 0.0, 0.0), (0.0, -0.3 * height, 0.0), (0.0, 0.0, math.pi)])
    assert np.allclose(footprint.overlaps(motions), [0.6, 0.7, 1.0], atol=0.06)


def test_odometry_that_drifts_is_neither_blamed_nor_believed(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    mapper, truth = slamcli.Mapper(photographer.calibration), passes(4)
    odometry, driven = Pose2(), 0.0
    for index, picture in enumerate(pictures):
        step = Pose2() if not index else truth[index - 1].inverse() @ truth[index]
        driven += step.translation_length
        # Two per cent too long, and to the left by a hundredth of the way.
        odometry = odometry @ Pose2(1.02 * step.x, step.y, step.theta + 0.05 * abs(step.x))
        stamp = index / RATE_HERTZ
        mapper.odometry(OdometryReading(stamp, odometry))
        mapper.update(slamcli.Frame(index, f"{index}", stamp, picture))
    assert driven > 0.8
    assert not mapper.sensor_faults
    estimates = mapper.finish()
    for estimate in estimates:
        assert error_of(estimate, truth[estimate.index])[0] < 0.0002
    # A robot steers by it: it never jumps.
    for before, now in pairwise(estimates):
        assert before.odom_from_robot is not None
        assert now.odom_from_robot is not None
        moved = before.odom_from_robot.inverse() @ now.odom_from_robot
        true = truth[before.index].inverse() @ truth[now.index]
        assert (true.inverse() @ moved).translation_length < 0.0003


def test_a_run_that_is_resumed_amid_known_floor_has_the_same_poses(
    photographer: photograph.Photographer, pictures: list[np.ndarray]
) -> None:
    whole = slamcli.Mapper(photographer.calibration)
    begun = slamcli.Mapper(photographer.calibration)
    frames = [slamcli.Frame(index, f"{index}", None, one) for index, one in enumerate(pictures)]
    for frame in frames:
        whole.update(frame)
    for frame in frames[:30]:
        begun.update(frame)
    state = pickle.loads(pickle.dumps(begun.state()))
    assert state.tracking.revisited
    resumed = slamcli.Mapper(photographer.calibration)
    resumed.restore(state, {n: resumed.prepare(frames[n]) for n in state.tracking.indices})
    for frame in frames[30:]:
        resumed.update(frame)
    for one, other in zip(whole.finish(), resumed.finish(), strict=True):
        assert one.map_from_robot == other.map_from_robot
