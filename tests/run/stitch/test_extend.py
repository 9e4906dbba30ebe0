"""`slam stitch --extend`: a later drive on a finished map, against the truth of one floor."""

from __future__ import annotations

import math
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import slam
from trajectories import read_poses, read_rows
from worlds import make_photographer, take

import slamcli
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import write_image
from slamcli.io.map_file import load_map, save_map
from slamcli.simulation import photograph

FIRST = [Pose2(0.06 * n) for n in range(8)]
# Across the first lane at another heading, and on over new floor.
LATER = [Pose2(0.42, -0.2, 1.9) @ Pose2(0.05 * n) for n in range(7)]


@pytest.fixture(scope="module")
def old() -> photograph.Photographer:
    return make_photographer()


def errors(estimates: list[slamcli.PoseEstimate], truth: list[Pose2]) -> list[float]:
    found = []
    for estimate, pose in zip(estimates, truth, strict=True):
        assert estimate.map_from_robot is not None, estimate.reason
        assert estimate.fragment == 0
        found.append((pose.inverse() @ estimate.map_from_robot).translation_length)
    return found


@pytest.fixture(scope="module")
def first_map(
    old: photograph.Photographer, tmp_path_factory: pytest.TempPathFactory
) -> slamcli.FloorMap:
    mapper = slamcli.Mapper(old.calibration)
    for number, pose in enumerate(FIRST):
        mapper.update(take(old, pose, number))
    mapper.finish()
    found = mapper.floor_map()
    assert found is not None
    path = tmp_path_factory.mktemp("first") / "map.slam"
    save_map(path, found)
    return load_map(path)


def test_a_map_holds_the_whole_drive(first_map: slamcli.FloorMap) -> None:
    assert max(errors(list(first_map.estimates), FIRST)) < 0.001
    assert len(first_map.links) >= len(FIRST) - 1
    assert 1 < len(first_map.keyframes) <= len(FIRST)
    for link in first_map.links:
        error = (FIRST[link.a].inverse() @ FIRST[link.b]).inverse() @ link.a_from_b
        assert error.translation_length < 0.001


def test_a_changed_floor_does_not_wreck_the_map(
    old: photograph.Photographer, first_map: slamcli.FloorMap
) -> None:
    """Beyond a line the floor is another one than before; the robot comes back over it."""
    new = make_photographer(9)
    width, height = old.calibration.image_size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2)
    on_floor = apply_homography(old.calibration.robot_from_image, pixels.astype(np.float64))
    # From known floor on to what has changed, and back to known floor at another place.
    way = [Pose2(0.03 + 0.05 * n, 0.02, 0.1) for n in range(10)]
    mapper = slamcli.Mapper(old.calibration)
    mapper.extend(first_map)
    for number, pose in enumerate(way):
        changed = (np.abs(pose.apply(on_floor)[:, 0] - 0.62) < 0.13).reshape(height, width)
        here, there = take(old, pose, 50 + number), take(new, pose, 70 + number)
        streamed = mapper.update(np.where(changed[..., None], there, here))
        if number == 0:
            assert streamed.fragment == 0, "the first frame is recognised at once"
    found = mapper.finish()
    assert max(errors(found, [*FIRST, *way])) < 0.002
    assert any(link.a < len(FIRST) <= link.b for link in mapper.links)


def test_another_place_is_a_map_of_its_own(
    old: photograph.Photographer, first_map: slamcli.FloorMap
) -> None:
    mapper = slamcli.Mapper(old.calibration)
    mapper.extend(first_map)
    for number in range(3):
        mapper.update(take(old, Pose2(6.0 + 0.06 * number, 4.0), 90 + number))
    found = mapper.finish()
    assert [e.fragment for e in found] == [0] * len(FIRST) + [1] * 3


@pytest.fixture(scope="module")
def drives(old: photograph.Photographer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drives")
    for name, poses, seed in (("first", FIRST, 0), ("later", LATER, 20)):
        (folder / name).mkdir()
        for number, pose in enumerate(poses):
            write_image(folder / name / f"{number}.png", take(old, pose, seed + number))
    save_calibration(folder / "first" / "calibration.yaml", old.calibration)
    result = slam("stitch", folder / "first", "-o", folder / "out")
    assert result.exit_code == 0, result.output
    return folder


def test_a_later_drive_is_added(drives: Path, tmp_path: Path) -> None:
    output = tmp_path / "both"
    result = slam("stitch", drives / "later", "--extend", drives / "out", "-o", output)
    assert result.exit_code == 0, result.output
    rows = read_rows(output / "poses.csv")
    assert [row["fragment"] for row in rows] == ["0"] * (len(FIRST) + len(LATER))
    for row, pose in zip(rows, [*FIRST, *LATER], strict=True):
        assert math.hypot(float(row["x"]) - pose.x, float(row["y"]) - pose.y) < 0.002
        turn = float(row["heading"]) - pose.theta
        assert abs(math.degrees(math.remainder(turn, math.tau))) < 0.3
    # The mosaic shows the floor of both.
    world = [float(line) for line in (output / "mosaic.pgw").read_text().splitlines()]
    before = [float(line) for line in (drives / "out" / "mosaic.pgw").read_text().splitlines()]
    assert world[5] > before[5] + 0.2
    sources = tomllib.loads((output / "run.toml").read_text())["sources"]
    assert [source.rsplit("/", 1)[-1] for source in sources] == ["first", "later"]
    result = slam("locate", output, drives / "later" / "6.png", "--json")
    assert result.exit_code == 0, result.output
    # And on: what was made so can be painted and gone on with again.
    assert len(load_map(output).estimates) == len(rows)
    assert read_poses(output / "poses.csv")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["first"], "part of that map already"),
        (["later", "-c", "first/calibration.yaml"], "the map's own camera"),
        (["later", "--self-calibrate"], "by the frames alone"),
        (["later", "--dry-run"], "does not take"),
    ],
)
def test_what_cannot_be_added_is_refused(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
) -> None:
    monkeypatch.chdir(drives)
    result = slam("stitch", *words, "--extend", "out", "-o", tmp_path / "no")
    assert result.exit_code in {1, 2}
    assert message in result.output
    assert not (tmp_path / "no").exists()


def move_sources(output: Path, *sources: Path) -> None:
    """Let the map in a folder say that its frames are elsewhere."""
    save_map(output / "map.slam", replace(load_map(output), sources=sources))


def test_frames_that_are_gone_are_named(drives: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    shutil.copytree(drives, moved)
    move_sources(moved / "out", moved / "first")
    (moved / "first" / "3.png").unlink()
    result = slam("stitch", moved / "later", "--extend", moved / "out", "-o", tmp_path / "no")
    assert result.exit_code == 1
    assert "frame 3 was 3" in result.output
    shutil.rmtree(moved / "first")
    result = slam("stitch", moved / "later", "--extend", moved / "out", "-o", tmp_path / "no")
    assert result.exit_code == 1
    assert "put them back" in result.output
    assert result.output.count("\n") == 1


def test_the_map_alone_is_extended(drives: Path, tmp_path: Path) -> None:
    """Nothing but map.slam is read of the earlier run."""
    alone = tmp_path / "alone.slam"
    shutil.copy(drives / "out" / "map.slam", alone)
    outputs = []
    for number, finished in enumerate((alone, drives / "out")):
        output = tmp_path / str(number)
        result = slam("stitch", drives / "later", "--extend", finished, "-o", output)
        assert result.exit_code == 0, result.output
        outputs.append([(output / name).read_bytes() for name in ("poses.csv", "mosaic.png")])
    assert outputs[0] == outputs[1]


def test_a_map_that_does_not_record_its_frames_is_refused(drives: Path, tmp_path: Path) -> None:
    shutil.copytree(drives / "out", tmp_path / "old")
    move_sources(tmp_path / "old")
    result = slam("stitch", drives / "later", "--extend", tmp_path / "old", "-o", tmp_path / "no")
    assert result.exit_code == 1
    assert "does not record where its frames are" in result.output
    assert result.output.count("\n") == 1
