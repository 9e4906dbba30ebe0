"""Frames in a video: the same map as from its frames as files, through every command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from bag_files import START, BagWriter, write_bag
from command_line import slam
from trajectories import compare, read_poses
from video_files import write_video
from worlds import CAMERA, make_photographer, take

import slamcli
from slamcli.core.geometry import Pose2
from slamcli.core.telemetry import TelemetryOptions
from slamcli.io.calibrations import load_intrinsics, save_calibration
from slamcli.io.telemetry import read_compass, read_gps, read_odometry
from slamcli.run.telemetry import TelemetryFiles, unused_note, with_antenna
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


def stitched(source: Path, output: Path, *options: object) -> Path:
    calibration = source.parent / "calibration.yaml"
    result = slam("stitch", source, "-c", calibration, "-o", output, *options)
    assert result.exit_code == 0, result.output
    return output


@pytest.fixture(scope="module")
def of_files(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return stitched(drive / "frames", tmp_path_factory.mktemp("files") / "map")


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


@pytest.fixture(scope="module", params=["drive.bag", "drive_mcap"])
def bag(request: pytest.FixtureRequest, drive: Path) -> Path:
    pictures = [cv2.imread(str(path)) for path in sorted((drive / "frames").iterdir())]

    def sensors(writer: BagWriter) -> None:
        for number in range(-5, 70):
            seconds, along = number / 100, 0.1 * number
            pose = Pose2(0.03 * along, 0.0, 0.05 * along)
            writer.odometry("/odom", max(0.0, seconds), pose.x, pose.y, pose.theta)
        writer.fix(0.0, 52.0, 13.0)
        writer.imu(0.0, 0.5)
        writer.lens("/camera/camera_info", CAMERA.size, 300.0)
        writer.transform("base_link", "gps", 0.3, -0.1, 0.0)

    return write_bag(drive / request.param, pictures, sensors)


def test_a_bag_gives_the_map_of_the_folder_extracted_from_it(bag: Path, tmp_path: Path) -> None:
    files = tmp_path / "files"
    result = slam("extract", bag, "-o", files)
    assert result.exit_code == 0, result.output
    assert "1 readings, for --gps --lever-arm 0.3,-0.1" in result.output
    lens = load_intrinsics(files / "camera_info.yaml")
    assert lens.image_size == CAMERA.size
    (files / "calibration.yaml").write_bytes((bag.parent / "calibration.yaml").read_bytes())
    of_bag = stitched(bag, tmp_path / "bag_map")
    of_files = stitched(files / "frames", tmp_path / "files_map")
    for product in ("poses.csv", "mosaic.png"):
        assert (of_bag / product).read_bytes() == (of_files / product).read_bytes(), product
    assert [one.stamp for one in slamcli.load_map(of_bag).estimates] == pytest.approx(
        [START + n / 10 for n in range(6)]
    )


def test_the_readings_of_a_bag_are_those_of_its_tables(bag: Path, tmp_path: Path) -> None:
    assert slam("extract", bag, "-o", tmp_path).exit_code == 0
    ours, theirs = read_odometry(bag), read_odometry(tmp_path / "odometry.csv")
    assert len(ours) == len(theirs) == 75
    for one, other in zip(ours, theirs, strict=True):
        assert one.stamp == other.stamp
        assert (one.pose.inverse() @ other.pose).translation_length < 1e-6
    assert read_gps(bag) == read_gps(tmp_path / "gps.csv")
    assert read_compass(bag)[0].heading_radians == pytest.approx(0.5)
    assert read_compass(tmp_path / "compass.csv")[0].sigma_radians == pytest.approx(0.1)


def test_readings_of_a_bag_that_no_option_names_are_listed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "drive.bag", [], lambda writer: writer.imu(0.0, 0.5))
    assert unused_note([path], TelemetryFiles(compass=path)) == ""
    listed = "drive.bag also has readings for --compass (/imu): name it there to use them"
    assert unused_note([path, tmp_path], TelemetryFiles(gps=path)) == listed


def test_the_antenna_is_where_the_transforms_of_a_bag_say(bag: Path) -> None:
    options = TelemetryOptions()
    found, note = with_antenna(options, Path(f"{bag}:/fix"))
    assert found.lever_arm_metres == (0.3, -0.1)
    assert note.endswith("--lever-arm 0.3,-0.1")
    for given in (replace(options, lever_arm_metres=None), replace(found, lever_arm_metres=(1, 2))):
        assert with_antenna(given, bag) == (given, "")
    for gps in (None, bag.parent / "gps.csv"):
        assert with_antenna(options, gps) == (options, "")


def test_one_time_step_is_given_once(drive: Path) -> None:
    result = slam("stitch", drive / "drive.mkv", "--fps", "5", "--every", "0.2")
    assert result.exit_code == 1
    assert "one of --every and --fps" in result.output
