"""Frames in a video: the same map as from its frames as files, through every command."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest
from command_line import slam
from trajectories import compare, read_poses
from video_files import write_video
from worlds import CAMERA, make_photographer, take

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.io.calibrations import save_calibration
from slamcli.simulation import photograph

POSES = [Pose2(0.03 * k, 0.0, 0.05 * k) for k in range(6)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six frames as files, as a video without loss, and as one that is stored turned."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "frames").mkdir()
    photographer = make_photographer()
    pictures = [take(photographer, pose, seed) for seed, pose in enumerate(POSES)]
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(folder / "frames" / f"{number / 10:.6f}.png"), picture)
    write_video(folder / "drive.mkv", pictures)
    stored = [cv2.rotate(picture, cv2.ROTATE_90_CLOCKWISE) for picture in pictures]
    write_video(folder / "turned.mkv", stored, turn_degrees=90)
    save_calibration(folder / "calibration.yaml", photograph.make_camera(CAMERA))
    return folder


def stitched(source: Path, output: Path, *options: str) -> Path:
    calibration = source.parent / "calibration.yaml"
    result = slam("stitch", source, "-c", calibration, "-o", output, *options)
    assert result.exit_code == 0, result.output
    return output


@pytest.fixture(scope="module")
def of_files(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("files") / "map"
    return stitched(drive / "frames", output, "--frame-rate", "10")


@pytest.fixture(scope="module")
def of_video(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stitched(drive / "drive.mkv", tmp_path_factory.mktemp("video") / "map")


def test_a_video_gives_the_map_of_its_frames(
    of_video: Path, of_files: Path, tmp_path: Path
) -> None:
    for product in ("poses.csv", "mosaic.png"):
        assert (of_video / product).read_bytes() == (of_files / product).read_bytes(), product
    truth = {f"{n / 10:.6f}.png": pose for n, pose in enumerate(POSES)}
    found = read_poses(of_video / "poses.csv")
    assert set(found) == set(truth)
    assert compare(found, truth).absolute_metres < 0.0005
    rendered = tmp_path / "again"
    result = slam("render", of_video, "-o", rendered)
    assert result.exit_code == 0, result.output
    assert (rendered / "mosaic.png").read_bytes() == (of_video / "mosaic.png").read_bytes()


def test_turned_back_and_with_two_workers_the_bytes_are_the_same(
    drive: Path, of_files: Path, tmp_path: Path
) -> None:
    turned = stitched(drive / "turned.mkv", tmp_path / "map", "--workers", "2")
    for product in ("poses.csv", "mosaic.png"):
        assert (turned / product).read_bytes() == (of_files / product).read_bytes()


def test_the_other_commands_take_a_video(drive: Path, of_files: Path, tmp_path: Path) -> None:
    clip = drive / "drive.mkv"
    camera = ("-c", drive / "calibration.yaml")
    found = slam("locate", of_files, clip, "--fps", "5")
    assert found.exit_code == 0, found.output
    assert "3 of 3 frames are on the map" in found.output
    warped = slam("warp", clip, *camera, "-o", tmp_path / "views", "--to", "0.2")
    assert warped.exit_code == 0, warped.output
    assert "drive.mkv: 3 of 3 frames taken" in warped.output
    assert (tmp_path / "views" / "0.100000.pgw").exists()
    detected = slam("detect", clip, *camera, "-o", tmp_path / "points", "--from", "0.3")
    assert detected.exit_code == 0, detected.output
    checked = slam("stitch", clip, *camera, "--dry-run")
    assert "none found" in checked.output


def test_a_map_of_a_video_is_extended_by_another(of_video: Path, tmp_path: Path) -> None:
    later = tmp_path / "later.mkv"
    photographer = make_photographer()
    poses = [POSES[-1] @ Pose2(0.02 * k, 0.0, 0.0) for k in range(1, 4)]
    write_video(later, [take(photographer, pose, 9) for pose in poses])
    result = slam("stitch", later, "--extend", of_video, "-o", tmp_path / "both")
    assert result.exit_code == 0, result.output
    floor_map = slamcli.load_map(tmp_path / "both")
    placed = [one.map_from_robot for one in floor_map.estimates]
    assert len(placed) == 9
    assert placed[-1] is not None
    error = (POSES[0].inverse() @ poses[-1]).inverse() @ placed[-1]
    assert error.translation_length < 0.001


def test_one_time_step_is_given_once(drive: Path) -> None:
    result = slam("stitch", drive / "drive.mkv", "--fps", "5", "--every", "0.2")
    assert result.exit_code == 1
    assert "one of --every and --fps" in result.output
