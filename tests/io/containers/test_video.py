"""Videos: true stamps, rotation, choice of frames, random access, and what is refused."""

from __future__ import annotations

import pickle
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from video_files import write_video

from slamcli.core.config import FrameSelection
from slamcli.core.errors import FrameError, InputError
from slamcli.io.containers import video
from slamcli.io.frames import FrameFile, list_frames, read_frame, read_reduced_gray

ALL = FrameSelection(frames_per_second=1000.0)


def noise(count: int, size: tuple[int, int] = (96, 64), seed: int = 0) -> list[np.ndarray]:
    generator = np.random.default_rng(seed)
    shape = (count, size[1], size[0], 3)
    return list(generator.integers(0, 256, shape, dtype=np.uint8))


def names(files: list[FrameFile]) -> list[str]:
    return [file.name for file in files]


def test_frames_have_the_stamps_and_pixels_that_were_written(tmp_path: Path) -> None:
    pictures, stamps = noise(5), [0.0, 0.1, 0.35, 0.4, 1.25]
    path = write_video(tmp_path / "v.mkv", pictures, stamps=stamps)
    files = list_frames([path], selection=ALL)
    assert [file.stamp for file in files] == stamps
    assert names(files)[2] == "0.350000.png"
    for file, picture in zip(files, pictures, strict=True):
        np.testing.assert_array_equal(read_frame(file).image, picture)


def test_a_frame_reads_as_a_png_of_it_does(tmp_path: Path) -> None:
    (picture,) = noise(1, (131, 97))
    (of_video,) = list_frames([write_video(tmp_path / "v.mkv", [picture])])
    assert cv2.imwrite(str(tmp_path / "p.png"), picture)
    (of_file,) = list_frames([tmp_path / "p.png"])
    for way in ({"gray": True}, {"halved": True}, {}):
        np.testing.assert_array_equal(
            read_frame(of_video, **way).image, read_frame(of_file, **way).image
        )
    np.testing.assert_array_equal(read_reduced_gray(of_video), read_reduced_gray(of_file))


@pytest.mark.parametrize(("degrees", "code"), [(90, 2), (180, 1), (-90, 0)])
def test_the_rotation_of_the_metadata_is_applied(tmp_path: Path, degrees: int, code: int) -> None:
    pictures = noise(2)
    (file, _) = list_frames([write_video(tmp_path / "v.mkv", pictures, turn_degrees=degrees)])
    turned = cv2.rotate(pictures[0], code)
    np.testing.assert_array_equal(read_frame(file).image, turned)
    assert file.size() == (turned.shape[1], turned.shape[0])


def test_frames_are_read_in_any_order_by_several_threads(tmp_path: Path) -> None:
    pictures = noise(40)
    path = write_video(tmp_path / "v.mkv", pictures, rate=1, keyframe_every=7)
    files = list_frames([path])
    order = np.random.default_rng(1).permutation(np.repeat(np.arange(40), 3))
    right: list[bool] = []

    def read(numbers: np.ndarray) -> None:
        images = [read_frame(files[number]).image for number in numbers]
        right.extend(map(np.array_equal, images, [pictures[number] for number in numbers]))

    threads = [threading.Thread(target=read, args=(order[first::3],)) for first in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(right) == 120
    assert all(right)


@pytest.mark.parametrize(
    ("name", "codec"), [("v.mp4", "libx264"), ("v.ts", "libx264"), ("v.avi", "mpeg4")]
)
def test_seeking_gives_the_same_pixels_as_reading_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, codec: str
) -> None:
    smooth = [cv2.GaussianBlur(np.roll(noise(1)[0], 2 * k, 1), (0, 0), 2) for k in range(60)]
    path = write_video(
        tmp_path / name, smooth, codec=codec, pixels="yuv420p", rate=2, keyframe_every=12
    )
    files = list_frames([path])
    assert len(files) == 60
    on = [read_frame(file) for file in files]
    monkeypatch.setattr(video, "_MAX_KEPT_BYTES", 0)
    again = list_frames([path])
    for number in (50, 3, 31, 30, 59, 0):
        assert read_frame(again[number]).digest == on[number].digest


def test_memory_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "v.mkv", noise(20))
    monkeypatch.setattr(video, "_MAX_KEPT_BYTES", 3 * 96 * 64 * 3)
    files = list_frames([path])
    for file in files:
        read_frame(file)
    assert files[0].part is not None
    assert len(files[0].part.video._kept) == 3


def test_the_sharpest_of_each_interval_is_taken(tmp_path: Path) -> None:
    pictures = [cv2.GaussianBlur(one, (0, 0), 2.0) for one in noise(12)]
    for number in (1, 3, 8, 9):
        pictures[number] = noise(12)[number]
    path = write_video(tmp_path / "v.mkv", pictures, rate=30)
    files = list_frames([path], selection=FrameSelection(every_seconds=0.1))
    assert names(files) == ["0.033000.png", "0.100000.png", "0.267000.png", "0.300000.png"]
    assert files[0].part is not None
    note = "v.mkv: 4 of 12 frames taken, the sharpest of each interval (--every)"
    assert files[0].part.note == note


def test_a_standing_camera_gives_one_frame(tmp_path: Path) -> None:
    floor = cv2.GaussianBlur(noise(1, (640, 480))[0], (0, 0), 3.0)
    floor = cv2.normalize(floor, None, 0, 255, cv2.NORM_MINMAX)
    generator = np.random.default_rng(2)
    places = [0, 0, 0, 0, 12, 24, 36, 36, 36, 48]
    pictures = []
    for place in places:
        noisy = np.roll(floor, place, 1) + generator.normal(0.0, 3.0, floor.shape)
        pictures.append(np.clip(noisy, 0, 255).astype(np.uint8))
    files = list_frames([write_video(tmp_path / "v.mkv", pictures)])
    assert names(files) == [f"0.{n}00000.png" for n in (0, 4, 5, 6, 9)]
    assert files[0].part is not None
    assert files[0].part.note.endswith("5 left out where the camera stands")


def test_a_plain_floor_is_never_taken_for_standing(tmp_path: Path) -> None:
    """A bright edge of the robot stands still in the picture, and the floor has only noise."""
    generator = np.random.default_rng(2)
    pictures = []
    for _ in range(6):
        picture = generator.normal(60.0, 6.0, (480, 640, 3))
        picture[400:, ::16] = 255
        pictures.append(np.clip(picture, 0, 255).astype(np.uint8))
    assert len(list_frames([write_video(tmp_path / "v.mkv", pictures)])) == 6


def test_a_part_of_the_video(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mkv", noise(20))
    part = FrameSelection(from_seconds=0.5, to_seconds=0.8)
    assert [file.stamp for file in list_frames([path], selection=part)] == [0.5, 0.6, 0.7, 0.8]
    with pytest.raises(InputError, match="no frame that can be read in the part"):
        list_frames([path], selection=FrameSelection(from_seconds=9.0))


def test_a_frame_rate_gives_other_stamps(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mkv", noise(3))
    assert [file.stamp for file in list_frames([path], frame_rate=2.0)] == [0.0, 0.5, 1.0]


def test_a_frame_can_be_sent_to_another_process(tmp_path: Path) -> None:
    pictures = noise(3)
    files = list_frames([write_video(tmp_path / "v.mkv", pictures)])
    read_frame(files[0])
    sent = pickle.loads(pickle.dumps(files))
    np.testing.assert_array_equal(read_frame(sent[2]).image, pictures[2])


def test_a_video_that_changes_is_noticed(tmp_path: Path) -> None:
    path = write_video(tmp_path / "v.mkv", noise(6))
    files = list_frames([path])
    write_video(path, noise(6, seed=5))
    with pytest.raises(FrameError, match="the video has changed"):
        read_frame(files[3])


@pytest.mark.parametrize(
    ("name", "codec", "pixels"), [("v.mp4", "libx264", "yuv420p"), ("v.mov", "mjpeg", "yuvj420p")]
)
def test_damage_costs_the_frames_that_it_reaches_and_no_others(
    tmp_path: Path, name: str, codec: str, pixels: str
) -> None:
    smooth = [cv2.GaussianBlur(np.roll(noise(1)[0], 2 * k, 1), (0, 0), 2) for k in range(24)]
    path = write_video(tmp_path / name, smooth, codec=codec, pixels=pixels, keyframe_every=6)
    whole = {file.stamp: read_frame(file).digest for file in list_frames([path])}
    data = bytearray(path.read_bytes())
    start = len(data) // 2
    data[start : start + 300] = b"\x55" * 300
    path.write_bytes(data)
    files = list_frames([path])
    assert 12 <= len(files) < 24
    assert all(whole[file.stamp] == read_frame(file).digest for file in files)
    assert files[0].part is not None
    assert "damaged" in files[0].part.note


@pytest.mark.parametrize("content", [b"", b"not a video at all", b"#EXTM3U\nfile:///etc/passwd\n"])
def test_what_is_no_video_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"cannot read the video .*v\.mp4"):
        list_frames([path])


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    import os

    os.mkfifo(tmp_path / "v.mp4")
    with pytest.raises(InputError, match="not a regular file"):
        list_frames([tmp_path / "v.mp4"])


def test_without_pyav_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "v.mkv", noise(1))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'slamcli\[video\]'"):
        list_frames([path])
