"""Names of files that are not UTF-8: mapped, written, located, rendered, drawn."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import pytest
from worlds import make_photographer, take

from slamcli.core.geometry import Pose2
from slamcli.core.names import readable
from slamcli.io.calibrations import save_calibration
from slamcli.io.map_file import load_map

pytestmark = pytest.mark.skipif(sys.platform == "darwin", reason="its file names are all UTF-8")


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("names") / os.fsdecode(b"fr\xe9")
    folder.mkdir()
    world = make_photographer()
    save_calibration(folder / "calibration.yaml", world.calibration)
    for number in range(3):
        picture = cv2.imencode(".png", take(world, Pose2(0.03 * number)))[1].tobytes()
        (folder / os.fsdecode(b"im\xff%d.png" % number)).write_bytes(picture)
    return folder


def slam(*words: object) -> str:
    """Run a command in a process of its own, on strict streams; return what it prints."""
    command = [sys.executable, "-m", "slamcli", *map(str, words)]
    env = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(command, env=env, capture_output=True, check=False)
    assert done.returncode == 0, (words, done.stdout[-500:], done.stderr[-2000:])
    return done.stdout.decode()


def test_frames_of_any_name_are_mapped_and_what_is_written_is_utf_8(
    frames: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    options = ("--frame-rate", 10, "--debug", "--export", "tum,links", "--no-dense")
    slam("stitch", frames, "-o", out, *options)
    assert r"im\xff1.png" in (out / "poses.csv").read_text(encoding="utf-8")
    run = tomllib.loads((out / "run.toml").read_text(encoding="utf-8"))
    assert r"fr\xe9" in repr(run).replace("\\\\", "\\")
    # The map has the true names: its frames are found again.
    assert load_map(out).estimates[1].name == os.fsdecode(b"im\xff1.png")
    for command in (
        ("render", out, "-o", tmp_path / "rendered"),
        ("locate", out, frames, "-o", tmp_path / "located.csv"),
        ("evaluate", out / "poses.csv", tmp_path / "located.csv"),
        ("detect", frames, "-o", tmp_path / "features"),
        ("warp", frames, "-o", tmp_path / "warped"),
    ):
        assert slam(*command)


def test_bytes_that_are_no_text_are_shown_as_such() -> None:
    assert readable(os.fsdecode(b"\xff\xc3\xa4")) == r"\xffä"
    assert readable("ä") == "ä"
