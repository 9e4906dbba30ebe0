"""The API's promise: `update` and `locate` never raise, and threads may share their objects."""

from __future__ import annotations

import gc
import os
import pickle
import resource
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import hostile_frames
import numpy as np
import pytest
from worlds import make_photographer, take

from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError, MapError
from slamcli.core.geometry import Pose2
from slamcli.core.records import FloorMap, Frame, PoseEstimate
from slamcli.core.telemetry import CompassReading, GpsReading, OdometryReading
from slamcli.io.map_file import load_map, save_map
from slamcli.mapping.localizer import Follower, Locator
from slamcli.mapping.mapper import Mapper

# 10,000 updates and readings in a minute: SLAMCLI_API_ROUNDS=10000.
ROUNDS = int(os.environ.get("SLAMCLI_API_ROUNDS", "200"))
WORLD = make_photographer()
GOOD = [take(WORLD, Pose2(0.02 * k, 0.0, 0.0)) for k in range(6)]


def small_mapper() -> Mapper:
    return Mapper(WORLD.calibration, MapperOptions(dense=False))


@pytest.fixture(scope="module")
def floor_map() -> FloorMap:
    mapper = small_mapper()
    for image in GOOD:
        mapper.update(image)
    mapper.finish()
    found = mapper.floor_map()
    assert found is not None
    return found


def give(mapper: Mapper, reading: Any) -> None:
    if isinstance(reading, OdometryReading):
        mapper.odometry(reading)
    elif isinstance(reading, CompassReading):
        mapper.compass(reading)
    elif isinstance(reading, GpsReading):
        mapper.gps(reading)


def test_hostile_updates_and_readings_raise_nothing_and_take_no_memory() -> None:
    rng = np.random.default_rng(5)
    mapper, before = small_mapper(), 0
    for number in range(ROUNDS):
        estimate = mapper.update(hostile_frames.frame(rng, GOOD[number % 6], number))
        assert isinstance(estimate, PoseEstimate)
        assert estimate.map_from_robot is not None or estimate.reason
        give(mapper, hostile_frames.reading(rng, float(number)))
        if number % 100 == 99:
            # Frames and keyframes of a map grow with it; what is refused must leave nothing.
            mapper.finish()
            mapper = small_mapper()
            gc.collect()
        if number == ROUNDS // 4:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown_megabytes = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    assert grown_megabytes < 100


def test_hostile_frames_leave_the_map_as_it_is_without_them() -> None:
    plain, disturbed = small_mapper(), small_mapper()
    for number, image in enumerate(GOOD):
        for bad in (np.nan, "7", 2**40, None):
            wrong = Frame(bad, "x", None, image)  # type: ignore[arg-type]
            assert disturbed.update(wrong).reason.startswith("its index is")
        assert disturbed.update(Frame(number, "x", float("nan"), image)).reason.startswith("its st")
        frame = Frame(number, "x", None, image)
        assert disturbed.update(frame).map_from_robot == plain.update(frame).map_from_robot
        assert disturbed.update(frame).reason.startswith(f"frame index {number} came before")
    assert len(disturbed.finish()) == len(GOOD)


def test_frames_that_cannot_be_used_leave_the_others_where_they_are_without_them() -> None:
    """To the last bit, where only their numbers are missing: these say how much time has passed."""
    with_them, without = small_mapper(), small_mapper()
    for number, image in enumerate(GOOD):
        frame = Frame(2 * number, str(number), None, image)
        assert with_them.update(frame).map_from_robot == without.update(frame).map_from_robot
        broken = Frame(2 * number + 1, "broken", None, np.zeros((9, 9), np.uint8))
        assert with_them.update(broken).reason
    ours = {e.index: e.map_from_robot for e in with_them.finish() if e.map_from_robot is not None}
    assert ours == {e.index: e.map_from_robot for e in without.finish()}


def test_pixels_of_any_layout_are_the_same_pixels() -> None:
    turned = np.ascontiguousarray(GOOD[1][::-1, ::-1])[::-1, ::-1]
    fortran = np.asfortranarray(GOOD[1])
    locked = hostile_frames.read_only(GOOD[1])
    found = []
    for image in (GOOD[1], turned, fortran, locked):
        mapper = small_mapper()
        mapper.update(GOOD[0])
        found.append(mapper.update(image).map_from_robot)
    assert found[0] is not None
    assert found.count(found[0]) == 4


def test_a_mask_of_another_kind_is_a_reason(floor_map: FloorMap) -> None:
    locator = Locator(floor_map)
    for mask in hostile_frames.masks(np.random.default_rng(1)):
        estimate = locator.locate(Frame(0, "x", None, GOOD[2], mask))
        assert estimate.map_from_robot is not None or estimate.reason


def test_locate_never_raises(floor_map: FloorMap) -> None:
    rng, locator = np.random.default_rng(7), Locator(floor_map)
    assert locator.locate(GOOD[3]).map_from_robot is not None
    for number in range(ROUNDS // 4):
        estimate = locator.locate(hostile_frames.frame(rng, GOOD[number % 6], number))
        assert estimate.map_from_robot is not None or estimate.reason


def test_what_a_robot_expects_may_be_anything(floor_map: FloorMap) -> None:
    rng = np.random.default_rng(11)
    locator = Locator(floor_map)
    follower = Follower(locator)
    for number in range(ROUNDS // 2):
        frame = hostile_frames.frame(rng, GOOD[number % 6], number)
        near, sigma = hostile_frames.expectation(rng)
        for estimate in (locator.locate(frame, near, sigma), follower.update(frame, near)):
            assert isinstance(estimate, PoseEstimate)
            assert estimate.map_from_robot is not None or estimate.reason
            # No warning, which some programs make an error, and no fault of this program's own.
            assert not estimate.reason.startswith("cannot be"), estimate.reason
    follower = Follower(locator)
    assert follower.update(GOOD[0]).map_from_robot is not None
    assert follower.update(GOOD[1], Pose2(float("nan"))).reason.startswith("the expected pose is")
    for image in GOOD[2:]:
        assert follower.update(image, Pose2(0.02)).map_from_robot is not None


def test_an_unforeseen_failure_is_a_reason_and_in_the_log_with_its_traceback(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    mapper = small_mapper()
    mapper.update(GOOD[0])

    def broken(*_: object) -> None:
        raise IndexError("a fault of ours")

    monkeypatch.setattr("slamcli.mapping.tracking.Tracker.track", broken)
    estimate = mapper.update(GOOD[1])
    assert estimate.reason == "cannot be placed: IndexError a fault of ours"
    (record,) = caplog.records
    assert record.name == "slamcli"
    assert record.exc_info is not None
    assert record.exc_info[0] is IndexError


def test_what_is_no_reading_is_refused() -> None:
    mapper = small_mapper()
    for give_it in (mapper.odometry, mapper.compass, mapper.gps):
        with pytest.raises(InputError, match="a reading of the type str, not"):
            give_it("reading")  # type: ignore[operator]


def test_threads_may_share_a_mapper_and_a_locator(floor_map: FloorMap) -> None:
    mapper, locator = small_mapper(), Locator(floor_map)
    with ThreadPoolExecutor(8) as threads:
        placed = list(threads.map(mapper.update, GOOD * 4))
        located = list(threads.map(locator.locate, GOOD * 2))
        readings = threads.map(
            mapper.odometry, [OdometryReading(float(k), Pose2(k)) for k in range(50)]
        )
        assert len(list(readings)) == 50
    assert sorted(estimate.index for estimate in placed) == list(range(24))
    assert all(estimate.map_from_robot is not None for estimate in located)
    assert len(mapper.finish()) == 24


def test_a_mapper_can_be_sent_to_another_machine_to_prepare_frames() -> None:
    copy = pickle.loads(pickle.dumps(small_mapper()))
    assert copy.prepare(Frame(0, "x", None, GOOD[0])).features is not None


def damaged(floor_map: FloorMap, cut: slice, fill: bytes) -> FloorMap:
    keyframes = []
    for keyframe in floor_map.keyframes:
        image = bytearray(keyframe.image)
        image[cut] = fill * len(image[cut])
        keyframes.append(replace(keyframe, image=bytes(image)))
    return replace(floor_map, keyframes=tuple(keyframes))


def test_a_keyframe_whose_picture_declares_another_size_is_a_map_error(
    floor_map: FloorMap, tmp_path: Any
) -> None:
    good = tmp_path / "good.slam"
    save_map(good, floor_map)
    assert load_map(good).keyframes
    one = floor_map.keyframes[0]
    huge = bytearray(one.mask)
    huge[16:24] = (30_000).to_bytes(4, "big") * 2
    for wrong in (replace(one, mask=bytes(huge)), replace(one, image=b"\xff\xd8\xff")):
        path = tmp_path / "wrong.slam"
        save_map(path, replace(floor_map, keyframes=(wrong, *floor_map.keyframes[1:])))
        with pytest.raises(MapError, match=r"pictures of its keyframe \d+ are damaged"):
            load_map(path)


def test_keyframes_with_damaged_pixels_leave_a_reason(floor_map: FloorMap) -> None:
    for cut, fill in ((slice(700, None), b"\0"), (slice(0, None), b"\xff"), (slice(2, 9), b"")):
        estimate = Locator(damaged(floor_map, cut, fill)).locate(GOOD[2])
        assert estimate.map_from_robot is not None or estimate.reason


@pytest.mark.parametrize(
    "change", [{"metres_per_pixel": 4e-6}, {"metres_per_pixel": 1e3}, {"tilt_sigma_degrees": 91.0}]
)
def test_numbers_from_which_too_much_memory_follows_are_a_map_error(
    floor_map: FloorMap, change: dict[str, float], tmp_path: Any
) -> None:
    save_map(tmp_path / "map.slam", replace(floor_map, **change))
    with pytest.raises(MapError):
        load_map(tmp_path / "map.slam")


def test_a_picture_size_from_which_too_much_memory_follows_is_a_map_error(
    floor_map: FloorMap, tmp_path: Any
) -> None:
    camera = replace(floor_map.calibration, image_size=(32_768, 32_768))
    save_map(tmp_path / "map.slam", replace(floor_map, calibration=camera))
    with pytest.raises(MapError, match="image_size"):
        load_map(tmp_path / "map.slam")
