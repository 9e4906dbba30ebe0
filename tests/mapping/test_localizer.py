"""Localisation in a finished map, `slam locate`, and map files that are safe to open."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import slam
from worlds import make_photographer, take

import slamcli
from slamcli.core.exit_codes import ExitCode
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, PreparedFrame
from slamcli.io.files import write_image
from slamcli.io.map_file import load_map, save_map
from slamcli.simulation import photograph


@pytest.fixture(scope="module")
def photographer() -> photograph.Photographer:
    return make_photographer()


@pytest.fixture(scope="module")
def map_file(
    photographer: photograph.Photographer, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    mapper = slamcli.Mapper(photographer.calibration)
    for index in range(8):
        mapper.update(take(photographer, Pose2(0.06 * index), index))
    mapper.finish()
    found = mapper.floor_map()
    assert found is not None
    path = tmp_path_factory.mktemp("map") / "map.slam"
    save_map(path, found)
    return path


def test_frames_are_found_at_any_heading_and_no_other_floor_is(
    photographer: photograph.Photographer, map_file: Path
) -> None:
    locator = slamcli.Locator(slamcli.load_map(map_file))
    middle = Pose2(0.22)
    for number in range(6):
        turn = Pose2(0.0, 0.0, number * math.tau / 6)
        truth = Pose2(0.05 * number, 0.02) @ middle @ turn @ middle.inverse()
        estimate = locator.locate(take(photographer, truth, 100 + number))
        assert estimate.map_from_robot is not None, estimate.reason
        error = truth.inverse() @ estimate.map_from_robot
        assert error.translation_length < 0.002
        assert abs(math.degrees(error.theta)) < 0.3
        assert estimate.covariance is not None
        assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0)
    for number in range(4):
        estimate = locator.locate(take(photographer, Pose2(6.0 + number, 3.0), 200 + number))
        assert estimate.status == "lost"
        assert estimate.reason.startswith("not here")
    assert locator.locate(np.zeros((240, 320, 3), np.uint8)).reason


def test_a_map_comes_back_as_it_was_saved(map_file: Path, tmp_path: Path) -> None:
    floor_map = load_map(map_file)
    save_map(tmp_path / "again.slam", floor_map)
    assert (tmp_path / "again.slam").read_bytes() == map_file.read_bytes()
    assert load_map(map_file.parent).metres_per_pixel == floor_map.metres_per_pixel
    assert all(keyframe.features.descriptors.dtype == np.uint8 for keyframe in floor_map.keyframes)


def forged(map_file: Path, change: Any) -> bytes:
    """Return a map with another header and a checksum that is right."""
    data = map_file.read_bytes()
    start = data.index(b"\n") + 1 + 32
    length = int.from_bytes(data[start : start + 8], "little")
    header = json.loads(data[start + 8 : start + 8 + length])
    rest = change(header, data[start + 8 + length :])
    text = json.dumps(header).encode()
    body = len(text).to_bytes(8, "little") + text + rest
    return data[: start - 32] + hashlib.sha256(body).digest() + body


def set_to(*keys: Any, value: Any) -> Any:
    def change(header: Any, rest: bytes) -> bytes:
        for key in keys[:-1]:
            header = header[key]
        header[keys[-1]] = value
        return rest

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_to("arrays", "points", 1, value=[10**9, 2]), "cut off"),
        (set_to("arrays", "points", 0, value="|O"), "kind"),
        (set_to("arrays", "rows", 1, value=[-1, 6]), "shape"),
        (set_to("features", "count", value=10**9), "count"),
        (set_to("features", "method", value="../orb"), "method"),
        (set_to("calibration", "image_size", value=[10**6, 10]), "image_size"),
        (set_to("calibration", "distortion_model", value="magic"), "distortion_model"),
        (set_to("calibration", "robot_from_image", value=[[0] * 3] * 3), "inverted"),
        (set_to("metres_per_pixel", value=float("nan")), "metres_per_pixel"),
        (set_to("norm", value="l3"), "norm"),
        (lambda header, rest: rest[:-1], "cut off"),
        (lambda header, rest: rest + b"x", "after its end"),
        (lambda header, rest: b"\xff" * 8 + rest[8:], "numbers of its frames"),
        (lambda header, rest: (header.clear(), rest)[1], "not a sound map"),
    ],
)
def test_a_forged_map_is_refused_in_one_line(
    map_file: Path, tmp_path: Path, change: Any, message: str
) -> None:
    path = tmp_path / "forged.slam"
    path.write_bytes(forged(map_file, change))
    with pytest.raises(slamcli.MapError, match=message) as caught:
        load_map(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data[:-1] + b"\0\0", "damaged"),
        (lambda data: data.replace(b"map 4\n", b"map 9\n", 1), "format version 9"),
        (lambda data: b"PK\x03\x04" + data, "not a map"),
        (lambda data: b"", "not a map"),
    ],
)
def test_a_spoilt_map_is_refused_in_one_line(
    map_file: Path, tmp_path: Path, spoil: Any, message: str
) -> None:
    path = tmp_path / "spoilt.slam"
    path.write_bytes(spoil(map_file.read_bytes()))
    with pytest.raises(slamcli.MapError, match=message):
        load_map(path)
    result = slam("locate", path, tmp_path)
    assert result.exit_code == 1
    assert result.output.startswith("Error: ")


def test_the_command_locates_frames(
    photographer: photograph.Photographer, map_file: Path, tmp_path: Path
) -> None:
    write_image(tmp_path / "a.png", take(photographer, Pose2(0.1, 0.01, 0.1), 300))
    write_image(tmp_path / "b.png", take(photographer, Pose2(9.0), 301))
    (tmp_path / "c.png").write_bytes(b"not a picture")
    frames = [tmp_path / f"{name}.png" for name in "abc"]
    table = tmp_path / "found.csv"
    result = slam("locate", map_file, *frames, "-o", table)
    assert result.exit_code == ExitCode.INCOMPLETE, result.output
    assert "incomplete: 1 of 3 frames are on the map" in result.output
    rows = table.read_text().splitlines()
    assert len(rows) == 4
    assert rows[1].split(",")[3] == "tracked"
    printed = slam("locate", map_file, *frames, "--json")
    entries = json.loads(printed.stdout)
    assert [entry["here"] for entry in entries] == [True, False, False]
    assert math.hypot(entries[0]["x"] - 0.1, entries[0]["y"] - 0.01) < 0.002
    alone = slam("locate", map_file, frames[1])
    assert alone.exit_code == ExitCode.ERROR
    half = slam("locate", map_file, *frames[:2])
    assert half.exit_code == ExitCode.DONE
    assert slam("locate", map_file, *frames[:2], "--strict").exit_code == ExitCode.INCOMPLETE


def test_a_frame_is_found_near_where_it_is_expected_without_features(
    photographer: photograph.Photographer, map_file: Path
) -> None:
    locator = slamcli.Locator(slamcli.load_map(map_file))
    truth = Pose2(0.2, 0.01, 0.05)
    prepared = locator.prepare(Frame(0, "0", None, take(photographer, truth, 100)))
    estimate = locator.place(prepared, truth @ Pose2(0.008, -0.006, 0.01))
    assert estimate.map_from_robot is not None, estimate.reason
    error = truth.inverse() @ estimate.map_from_robot
    assert error.translation_length < 0.0005
    assert abs(math.degrees(error.theta)) < 0.1
    assert (estimate.inliers, prepared.extraction is not None) == (0, True)
    assert not is_computed(prepared)


@pytest.mark.parametrize("expected", [Pose2(0.4, 0.1, 0.5), Pose2(50.0)])
def test_a_frame_is_found_where_it_is_however_wrong_the_expectation(
    photographer: photograph.Photographer, map_file: Path, expected: Pose2
) -> None:
    locator = slamcli.Locator(slamcli.load_map(map_file))
    truth = Pose2(0.1)
    estimate = locator.locate(take(photographer, truth, 100), expected, (0.01, 0.01))
    assert estimate.map_from_robot is not None, estimate.reason
    assert (truth.inverse() @ estimate.map_from_robot).translation_length < 0.002
    elsewhere = locator.locate(take(photographer, Pose2(6.0, 3.0), 200), truth)
    assert elsewhere.status == "lost"
    assert elsewhere.reason.startswith("not here")


def test_a_robot_is_followed_and_found_again(
    photographer: photograph.Photographer, map_file: Path
) -> None:
    locator = slamcli.Locator(slamcli.load_map(map_file))
    follower = slamcli.Follower(locator)
    drive = [Pose2(0.03 + 0.02 * step, 0.0, 0.01 * step) for step in range(8)]
    # It is carried elsewhere, off the map, and back.
    drive[5], drive[6] = Pose2(6.0, 3.0), Pose2(0.05, 0.0, 0.3)
    featured = []
    for number, truth in enumerate(drive):
        prepared = locator.prepare(Frame(number, "", None, take(photographer, truth, number)))
        estimate = follower.place(prepared)
        featured.append(is_computed(prepared))
        if number == 5:
            assert estimate.status == "lost"
            continue
        assert estimate.map_from_robot is not None, estimate.reason
        assert (truth.inverse() @ estimate.map_from_robot).translation_length < 0.002
    # Only where nothing is expected, or something else.
    assert featured[0]
    assert not any(featured[2:5])
    assert featured[5:7] == [True, True]


def is_computed(prepared: PreparedFrame) -> bool:
    """Return whether features were extracted."""
    assert prepared.extraction is not None
    return prepared.extraction._compute is None


def test_slam_locate_follows_a_drive(
    photographer: photograph.Photographer, map_file: Path, tmp_path: Path
) -> None:
    for index in range(4):
        write_image(
            tmp_path / f"{index}.png", take(photographer, Pose2(0.05 + 0.02 * index), index)
        )
    found = slam("locate", map_file, tmp_path, "--follow", "--json")
    assert found.exit_code == 0
    entries = json.loads(found.stdout)
    assert [entry["x"] for entry in entries] == pytest.approx([0.05, 0.07, 0.09, 0.11], abs=0.002)
    assert entries[3]["inliers"] == 0
