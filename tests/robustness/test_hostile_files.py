"""Files and names that no camera writes: pipes, links in circles, terabytes of zeros, controls."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import pytest
from boundaries import set_up
from command_line import slam

from slamcli.core.errors import CalibrationError, FrameError, InputError, MapError
from slamcli.core.names import printable
from slamcli.io.array_file import read_arrays
from slamcli.io.frames import list_frames
from slamcli.io.map_file import load_map
from slamcli.io.networks import load_match_network
from slamcli.io.toml import read_toml
from slamcli.run.inputs import open_inputs

TERABYTE = 2**40


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, here = tmp_path_factory.mktemp("inputs"), Path.cwd()
    os.chdir(folder)
    set_up()
    os.chdir(here)
    return folder


def sparse(path: Path, start: bytes = b"") -> Path:
    path.write_bytes(start)
    os.truncate(path, TERABYTE)
    return path


def test_a_map_or_state_that_is_a_pipe_or_a_terabyte_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.slam")
    for path in (tmp_path / "pipe.slam", sparse(tmp_path / "large.slam"), Path("/dev/zero")):
        with pytest.raises(MapError, match=r"is not a regular file|has more than 16384 MB"):
            load_map(path)
        with pytest.raises(InputError, match=r"is not a regular file|has more than 16384 MB"):
            read_arrays(path, b"magic\n")


def test_a_large_file_that_is_no_map_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "map.slam").write_bytes(b"")
    os.truncate(tmp_path / "map.slam", 15 * 2**30)
    with pytest.raises(MapError, match="is not a map"):
        load_map(tmp_path / "map.slam")


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_a_bag_that_begins_as_none_does_is_not_searched(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("rosbags")
    with pytest.raises(InputError, match=rf"does not begin as a {suffix} file"):
        list_frames([sparse(tmp_path / f"drive{suffix}")])


def test_the_description_of_a_bag_is_a_file_of_bounded_size(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    (tmp_path / "drive_0.db3").write_bytes(b"SQLite format 3\0")
    sparse(tmp_path / "metadata.yaml")
    with pytest.raises(InputError, match=r"metadata.yaml: it has more than 64 MB"):
        list_frames([tmp_path])


def test_a_calibration_that_is_a_broken_link_is_not_overlooked(
    inputs: Path, tmp_path: Path
) -> None:
    frames = tmp_path / "frames"
    shutil.copytree(inputs / "plain", frames)
    assert open_inputs([frames], None).calibration_path is None
    (frames / "calibration.yaml").symlink_to("nowhere.yaml")
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        open_inputs([frames], None)


def test_a_heic_without_a_header_is_no_picture_of_no_size(tmp_path: Path) -> None:
    pytest.importorskip("pillow_heif")
    (tmp_path / "0.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(300))
    (file,) = list_frames([tmp_path / "0.heic"])
    with pytest.raises(FrameError, match="damaged"):
        file.size()


def test_links_in_circles_and_outputs_among_the_frames_are_not_frames(
    inputs: Path, tmp_path: Path
) -> None:
    frames = tmp_path / "frames"
    shutil.copytree(inputs / "frames", frames)
    (frames / "again").symlink_to(frames)
    for output in (frames / "out", frames / "out 2"):
        result = slam("stitch", frames, "-o", output, "--metres-per-pixel", "0.004")
        assert result.exit_code == 0, result.output
        assert len((output / "poses.csv").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    "words",
    [
        ["stitch", "x" * 300, "-o", "out"],
        ["stitch", "frames", "-o", "x" * 300],
        ["stitch", "frames", "-c", "x" * 300],
        ["warp", "frames", "-o", "x" * 300],
        ["evaluate", "x" * 300, "x" * 300],
        ["view", "x" * 300],
    ],
)
def test_a_name_that_is_too_long_is_one_line(
    inputs: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    monkeypatch.chdir(inputs)
    result = slam(*words)
    assert result.exit_code == 1
    assert result.output.splitlines()[-1].startswith("Error: ")
    assert "File name too long" in result.output


def test_what_a_name_has_for_a_terminal_is_written_out(tmp_path: Path) -> None:
    assert printable("a\x1b[31mb\x07\x9b\tc\n") == "a\\x1b[31mb\\x07\\x9b\tc\n"
    result = slam("stitch", tmp_path / "no\x1b]0;title\x07 such\nfolder", "-o", tmp_path / "out")
    assert result.exit_code == 1
    (line,) = result.output.splitlines()
    assert line.startswith("Error: ")
    assert r"no\x1b]0;title\x07 such\nfolder does not exist" in line


def test_a_network_that_is_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.onnx")
    with pytest.raises(InputError, match="it is not a regular file"):
        load_match_network(tmp_path / "pipe.onnx")


@pytest.mark.parametrize("key", [".".join(["a"] * 60_000), " . ".join(['"a"'] * 30_000)])
def test_keys_of_many_parts_take_no_time(tmp_path: Path, key: str) -> None:
    for text in (f"{key} = 1\n", f"[{key}]\n", f"a = {{{key} = 1}}\n"):
        (tmp_path / "a.toml").write_text(text)
        began = time.process_time()
        with pytest.raises(InputError, match="nested too deeply"):
            read_toml(tmp_path / "a.toml", "layout")
        assert time.process_time() - began < 1.0
    (tmp_path / "a.toml").write_text("a = [" + "0.1, " * 60_000 + "]\n")
    assert len(read_toml(tmp_path / "a.toml", "layout")["a"]) == 60_000
