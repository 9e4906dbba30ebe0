"""Sequences as public benchmarks lay them out: HD Ground, PathTex, TUM."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path

import cv2
import floor_pictures
import numpy as np
import pytest
from click.testing import CliRunner

from slamcli.cli.main import main
from slamcli.core.errors import InputError
from slamcli.io.frames import list_frames
from slamcli.io.sequences import has_listed_poses, sequence_of
from slamcli.io.trajectories import read_trajectory

SIZE = (320, 240)
# A picture's upper left corner on the map, columns and rows, and its turn clockwise, degrees.
PLACES = [(200.0, 150.0, 0.0), (260.0, 170.0, 3.0), (330.0, 180.0, 8.0), (395.0, 215.0, 5.0)]


def run(*words: object):
    return CliRunner().invoke(main, [str(word) for word in words])


def map_from_image(column: float, row: float, degrees: float) -> np.ndarray:
    turn = math.radians(degrees)
    cosine, sine = math.cos(turn), math.sin(turn)
    return np.array([[cosine, -sine, column], [sine, cosine, row], [0.0, 0.0, 1.0]])


def name_of(number: int) -> str:
    return f"HDG1_t001_train_2020-09-23_s0001_c01_i{number:07}.png"


@pytest.fixture
def hd_ground(tmp_path: Path) -> Path:
    """The folder of an application area: seq0001, test_path.test and, with poses, test_path.txt."""
    (tmp_path / "seq0001").mkdir()
    floor = floor_pictures.asphalt(800)
    paths, poses = [], []
    for number, place in enumerate(PLACES, start=1):
        matrix = map_from_image(*place)
        shown = cv2.warpPerspective(floor, matrix, SIZE, flags=cv2.INTER_CUBIC | 16)
        cv2.imwrite(str(tmp_path / "seq0001" / name_of(number)), shown)
        paths.append(f"seq0001/{name_of(number)}")
        poses.append(" ".join(f"{value:.6f}" for value in matrix.ravel()))
    (tmp_path / "test_path.test").write_text("\n".join(paths) + "\n")
    lines = [f"{path} {pose}" for path, pose in zip(paths, poses, strict=True)]
    (tmp_path / "test_path.txt").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_a_sequence_of_hd_ground_is_mapped_and_evaluated(hd_ground: Path) -> None:
    output = hd_ground / "out"
    done = run("stitch", hd_ground / "test_path.test", "-o", output)
    assert done.exit_code == 0, done.output
    result = run("evaluate", output / "poses.csv", hd_ground / "test_path.txt", "--json")
    assert result.exit_code == 0, result.output
    errors = json.loads(result.stdout)
    assert (errors["matched"], errors["matched_by"]) == (4, "frame names")
    assert errors["whole"]["absolute"]["largest"] < 0.2
    assert errors["whole"]["heading"]["largest"] < 0.05


@pytest.mark.parametrize("separator", [" ", ";", ", ", "\t"])
def test_poses_of_hd_ground_are_those_of_top_down_frames(hd_ground: Path, separator: str) -> None:
    path = hd_ground / "test_path.txt"
    lines = path.read_text().replace(" ", separator).splitlines()
    name, pose = lines[2].split(separator, 1)
    lines[2] = separator.join([name, "* " + pose])
    path.write_text("\n".join(lines))
    found = read_trajectory(path)
    assert found.names == (name_of(1), name_of(2), name_of(4))
    assert found.unplaced == 1
    # The middle of a picture of 320 x 240, y up.
    np.testing.assert_allclose(found.poses[0], [359.5, -269.5, 0.0], atol=1e-5)
    assert math.degrees(found.poses[1, 2]) == pytest.approx(-3.0)
    # Without the pictures they are taken to be as large as the published ones.
    for picture in (hd_ground / "seq0001").iterdir():
        picture.unlink()
    np.testing.assert_allclose(read_trajectory(path).poses[0, :2], [999.5, -749.5], atol=1e-5)


def test_a_folder_of_pathtex_has_its_order_and_stamps(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    names = ["b10.png", "b9.png", "a.png"]
    for number, name in enumerate([*names, "unlisted.png"]):
        cv2.imwrite(str(tmp_path / "rgb" / name), np.full((40, 50), 50 * number, np.uint8))
    (tmp_path / "image_names.txt").write_text("\n".join(names))
    (tmp_path / "times.txt").write_text("1615972338.5\n1615972338.6\n1615972338.7\n")
    (tmp_path / "groundtruth_leica.txt").write_text("1615972338.5 0 0 0 0 0 0 1\n")
    files = list_frames([tmp_path])
    assert [file.name for file in files] == names
    assert [file.stamp for file in files] == pytest.approx(
        [1615972338.5, 1615972338.6, 1615972338.7]
    )
    assert [file.stamp for file in list_frames([tmp_path], frame_rate=5.0)] == [0.0, 0.2, 0.4]
    assert len(read_trajectory(tmp_path)) == 1
    (tmp_path / "times.txt").write_text("1.5\n")
    with pytest.raises(InputError, match="1 stamps for 3 pictures"):
        list_frames([tmp_path])
    (tmp_path / "times.txt").write_text("1.5\n1.6\nlate\n")
    with pytest.raises(InputError, match=r"times\.txt, line 3: late is no stamp"):
        list_frames([tmp_path])


def test_a_list_of_tum_gives_the_stamps(tmp_path: Path) -> None:
    (tmp_path / "rgb").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / "rgb" / f"{number}.png"), np.zeros((40, 50), np.uint8))
    path = tmp_path / "rgb.txt"
    path.write_text("# color images\n1305031102.175304 rgb/0.png\n1305031102.211214 rgb/1.png\n")
    assert [file.stamp for file in list_frames([path])] == [1305031102.175304, 1305031102.211214]
    path.write_text("1305031102.175304 rgb/2.png\n")
    with pytest.raises(InputError, match=r"rgb\.txt, line 1: rgb/2\.png does not exist"):
        list_frames([path])
    path.write_text("a note\n")
    with pytest.raises(InputError, match="line 1: no picture"):
        list_frames([path])


def test_a_pose_that_is_no_motion_is_refused(hd_ground: Path) -> None:
    path = hd_ground / "test_path.txt"
    path.write_text(f"seq0001/{name_of(1)} 2 0 1 0 2 1 0 0 1\n")
    with pytest.raises(InputError, match="line 1: the pose is not a turn and a shift"):
        read_trajectory(path)
    path.write_text(f"seq0001/{name_of(1)} 1 0 1 0 1 1 0 0 1\nseq0001/{name_of(2)} 1 0 1\n")
    with pytest.raises(InputError, match="line 2: a picture and 9 numbers"):
        read_trajectory(path)
    (hd_ground / "groundtruth_a.txt").write_text("")
    (hd_ground / "groundtruth_b.txt").write_text("")
    with pytest.raises(InputError, match="several files of poses, groundtruth_a"):
        read_trajectory(hd_ground)


@pytest.mark.parametrize("line", ["a" * 300_000, "a.b " * 100_000, "a " * 200_000])
def test_a_long_line_without_a_picture_takes_no_time(tmp_path: Path, line: str) -> None:
    (tmp_path / "list.txt").write_text(f"{line}\n")
    began = time.process_time()
    with pytest.raises(InputError, match="no picture"):
        sequence_of(tmp_path / "list.txt")
    assert not has_listed_poses(line)
    assert time.process_time() - began < 1.0


def test_a_name_that_no_file_can_have_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("x" * 300 + ".png\n")
    with pytest.raises(InputError, match="line 1: File name too long"):
        sequence_of(tmp_path / "list.txt")
