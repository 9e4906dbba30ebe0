"""ROS 1 and 2 bags: pictures of every encoding, topics, readings, and what is refused."""

from __future__ import annotations

import contextlib
import math
import pickle
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from bag_files import START, BagWriter, write_bag

from slamcli.core.config import FrameSelection
from slamcli.core.errors import CalibrationError, FrameError, InputError
from slamcli.io.calibrations import load_intrinsics
from slamcli.io.containers.bag_readings import antenna_metres, reading_topics
from slamcli.io.frames import list_frames, read_frame
from slamcli.io.telemetry import read_compass, read_gps, read_odometry

KINDS = ("b.bag", "b_db3", "b_mcap")


def noise(count: int, size: tuple[int, int] = (48, 32)) -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return list(generator.integers(0, 256, (count, size[1], size[0], 3), dtype=np.uint8))


def sensors(bag: BagWriter) -> None:
    for number in range(5):
        seconds = 0.1 * number
        bag.odometry("/odom", seconds, 0.2 * number, -0.1, 0.3 * number)
        bag.fix(seconds, 52.0 + 1e-5 * number, 13.0, status=-1 if number == 2 else 0)
        bag.imu(seconds, 1.0 + 0.1 * number)
    bag.lens("/camera/camera_info", (48, 32), 40.0)
    bag.lens("/rear/camera_info", (48, 32), 50.0)
    bag.transform("base_link", "mast", 1.0, 0.5, math.pi / 2)
    bag.transform("mast", "gps", 0.25, 0.0, 0.0)


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("encoding", ["bgr8", "png"])
def test_pictures_and_stamps_are_those_that_were_recorded(
    tmp_path: Path, name: str, encoding: str
) -> None:
    pictures = noise(4)
    files = list_frames([write_bag(tmp_path / name, pictures, encoding=encoding)])
    assert [file.stamp for file in files] == [START + 0.1 * n for n in range(4)]
    assert files[1].name == f"{START}.100000.png"
    for number in (3, 0, 2, 1):
        np.testing.assert_array_equal(read_frame(files[number]).image, pictures[number])
    sent = pickle.loads(pickle.dumps(files))
    np.testing.assert_array_equal(read_frame(sent[2]).image, pictures[2])


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_the_file_in_the_folder_of_a_bag_will_do(tmp_path: Path, suffix: str) -> None:
    folder = write_bag(tmp_path / f"b_{suffix[1:]}", noise(3))
    (path,) = folder.glob(f"*{suffix}")
    assert len(list_frames([path])) == 3


def test_every_encoding_is_read(tmp_path: Path) -> None:
    colour = cv2.GaussianBlur(noise(1)[0], (0, 0), 3.0)
    gray = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)
    mosaic = np.where(np.add.outer(np.arange(32), np.arange(48)) % 2, colour[..., 1], 0)
    mosaic[::2, ::2], mosaic[1::2, 1::2] = colour[::2, ::2, 2], colour[1::2, 1::2, 0]
    yuv = cv2.cvtColor(colour, cv2.COLOR_BGR2YUV_UYVY)
    pixels = {
        "rgb8": (colour[..., ::-1], 0, colour),
        "bgra8": (np.dstack([colour, gray]), 0, colour),
        "8UC4": (np.dstack([colour, gray]), 0, colour),
        "rgb16": (colour[..., ::-1].astype("<u2") << 8, 0, colour),
        "bgr16": (colour.astype("<u2") << 8, 0, colour),
        "rgba16": (np.dstack([colour[..., ::-1], gray]).astype("<u2") << 8, 0, colour),
        "bgra16": (np.dstack([colour, gray]).astype("<u2") << 8, 0, colour),
        "mono8": (gray, 0, np.dstack([gray] * 3)),
        "mono16": (gray.astype("<u2") << 4, 0, np.dstack([gray] * 3)),
        "bayer_rggb8": (mosaic.astype(np.uint8), 12, colour),
        "yuv422": (yuv, 40, colour),
    }
    for encoding, (stored, tolerance, expected) in pixels.items():
        path = tmp_path / f"{encoding}.bag"
        with BagWriter(path) as bag:
            bag.image("/camera/image", 0.0, np.ascontiguousarray(stored), encoding)
        image = read_frame(list_frames([path])[0]).image[4:-4, 4:-4].astype(int)
        assert np.abs(image - expected[4:-4, 4:-4]).max() <= tolerance, encoding


def test_an_encoding_that_is_not_read_is_named(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b.bag") as bag:
        bag.image("/camera/image", 0.0, np.zeros((32, 48), np.float64), "64FC1")
    with pytest.raises(InputError, match=r"no frame .*\(a ROS image of encoding '64FC1' is not"):
        list_frames([tmp_path / "b.bag"])


def test_one_range_of_16_bits_is_used_for_all_frames(tmp_path: Path) -> None:
    ramp = np.tile(np.arange(48, dtype="<u2"), (32, 1))
    with BagWriter(tmp_path / "b.bag") as bag:
        bag.image("/camera/image", 0.0, ramp, "mono16")
        bag.image("/camera/image", 1.0, (ramp * 80).astype("<u2"), "mono16")
    dark, bright = (read_frame(file).image for file in list_frames([tmp_path / "b.bag"]))
    assert (dark.max(), bright.max()) == (47 >> 4, 3760 >> 4)


def test_depth_and_copies_are_no_choice_and_several_cameras_are(tmp_path: Path) -> None:
    (picture,) = noise(1)

    def one_camera(bag: BagWriter) -> None:
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        bag.compressed("/camera/image/compressed", 0.0, data)
        bag.image("/camera/depth", 0.0, picture[..., :2].copy().view("<u2")[..., 0], "16UC1")

    path = write_bag(tmp_path / "one.bag", [picture], one_camera)
    np.testing.assert_array_equal(read_frame(list_frames([path])[0]).image, picture)

    def two_cameras(bag: BagWriter) -> None:
        bag.image("/rear/image", 0.0, picture[::-1].copy(), "bgr8")

    path = write_bag(tmp_path / "two.bag", [picture], two_cameras)
    with pytest.raises(InputError, match=r"on /camera/image \(1\), /rear/image \(1\); choose one"):
        list_frames([path])
    (rear,) = list_frames([path], selection=FrameSelection(topic="/rear/image"))
    np.testing.assert_array_equal(read_frame(rear).image, picture[::-1])
    with pytest.raises(InputError, match="has no topic /front of images; it has /camera/image"):
        list_frames([path], selection=FrameSelection(topic="/front"))


@pytest.mark.parametrize("name", KINDS)
def test_readings_are_those_that_were_recorded(tmp_path: Path, name: str) -> None:
    path = write_bag(tmp_path / name, noise(1), sensors)
    odometry = read_odometry(path)
    assert [one.stamp for one in odometry] == pytest.approx([START + 0.1 * n for n in range(5)])
    last = odometry[-1].pose
    assert (last.x, last.y, last.theta) == pytest.approx((0.8, -0.1, 1.2))
    fixes = read_gps(path)
    assert [one.latitude_degrees for one in fixes] == [52.0, 52.00001, 52.00003, 52.00004]
    assert fixes[0].sigma_metres == pytest.approx(0.5)
    headings = read_compass(path)
    assert headings[2].heading_radians == pytest.approx(1.2)
    assert headings[2].sigma_radians == pytest.approx(0.1)
    assert antenna_metres(path) == pytest.approx((1.0, 0.75))
    lens = load_intrinsics(Path(f"{path}:/rear/camera_info"))
    assert lens.image_size == (48, 32)
    assert lens.camera_matrix[0, 0] == 50.0
    with pytest.raises(CalibrationError, match=r"choose one, as .*:/camera/camera_info"):
        load_intrinsics(path)
    topics = {"--odometry": "/odom", "--gps": "/fix", "--compass": "/imu"}
    assert reading_topics(path) == topics


def test_several_topics_of_odometry_are_told_apart(tmp_path: Path) -> None:
    def two(bag: BagWriter) -> None:
        bag.odometry("/fused", 0.0, 1.0, 0.0, 0.0)
        bag.odometry("/wheels", 0.0, 2.0, 0.0, 0.0)

    path = write_bag(tmp_path / "b.bag", noise(1), two)
    with pytest.raises(InputError, match=r"choose one, as b\.bag:/fused"):
        read_odometry(path)
    assert read_odometry(Path(f"{path}:/wheels"))[0].pose.x == 2.0


def test_a_damaged_picture_costs_that_frame(tmp_path: Path) -> None:
    whole = cv2.imencode(".png", noise(1)[0])[1].tobytes()
    with BagWriter(tmp_path / "b.bag") as bag:
        bag.compressed("/c", 0.0, whole)
        bag.compressed("/c", 1.0, whole[:60])
        bag.image("/other", 0.0, noise(1)[0], "32FC3")
    (file,) = list_frames([tmp_path / "b.bag"], selection=FrameSelection(topic="/c"))
    assert file.part is not None
    assert file.part.note.startswith("b.bag, /c: 1 of 2 frames taken, 1 damaged")
    with pytest.raises(InputError, match="no frame that can be read"):
        list_frames([tmp_path / "b.bag"], selection=FrameSelection(topic="/other"))


def test_a_bag_that_changes_is_noticed(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "b.bag", noise(2))
    files = list_frames([path])
    path.unlink()
    write_bag(path, noise(2), step_seconds=0.5)
    sent = pickle.loads(pickle.dumps(files[1]))
    with pytest.raises(FrameError, match="has changed since it was read first"):
        read_frame(sent)


@pytest.mark.parametrize("name", ["b.bag", "b.db3", "b.mcap"])
@pytest.mark.parametrize("content", [b"", b"no bag" * 50])
def test_what_is_no_bag_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"cannot read the bag .*b\."):
        list_frames([tmp_path / name])


@pytest.mark.parametrize("name", KINDS)
def test_a_bag_that_is_cut_off_or_overwritten_is_refused_or_read(tmp_path: Path, name: str) -> None:
    path = write_bag(tmp_path / name, noise(6), sensors)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    whole = file.read_bytes()
    for share in (0.1, 0.5, 0.9):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=r"cannot read the bag|no frame"):
            list_frames([path])
    generator = np.random.default_rng(0)
    for _ in range(8):
        data = bytearray(whole)
        start = int(generator.integers(0, len(data) - 64))
        data[start : start + 64] = generator.integers(0, 256, 64, dtype=np.uint8).tobytes()
        file.write_bytes(bytes(data))
        with contextlib.suppress(InputError, FrameError):
            for frame in list_frames([path]):
                read_frame(frame)


def test_without_rosbags_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_bag(tmp_path / "b.bag", noise(1))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(InputError, match=r"pip install 'slamcli\[rosbag\]'"):
        list_frames([path])
