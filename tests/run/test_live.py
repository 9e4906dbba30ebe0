"""`slam live`: a stream mapped and located while it runs, recorded, and shown on a page."""

from __future__ import annotations

import csv
import json
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, browser
from command_line import slam
from live_stream import free_port, get, state_of, stream
from worlds import make_photographer, take

from slamcli.core.errors import OutputError
from slamcli.core.geometry import Pose2
from slamcli.io.calibrations import save_calibration
from slamcli.io.checkpoints import Checkpoint
from slamcli.io.frames import FrameFile
from slamcli.io.live_camera import Shot
from slamcli.io.locks import lock_on
from slamcli.run.live.recording import Recording

TRUTH = [Pose2(0.05 * number, 0.005 * number, 0.02 * number) for number in range(5)]


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    photographer = make_photographer()
    return [take(photographer, pose, seed) for seed, pose in enumerate(TRUTH)]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "calibration.yaml"
    save_calibration(path, make_photographer().calibration)
    return path


@pytest.fixture(scope="module")
def mapped(
    pictures: list[np.ndarray], calibration: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder with the map of the stream, its recording, and what the page had at the end."""
    folder, port = tmp_path_factory.mktemp("live"), free_port()

    def keep() -> None:
        (folder / "state.json").write_bytes(get(port, "/state.json"))
        (folder / "floor.png").write_bytes(get(port, "/map.png"))
        (folder / "picture.jpg").write_bytes(get(port, "/picture.jpg"))

    given = ["-c", calibration, "-o", folder / "map", "--record", folder / "kept"]
    with stream(pictures, port, keep) as source:
        done = slam("live", source, *given, "--port", port, "--no-browser")
    assert done.exit_code == 0, done.output
    (folder / "output.txt").write_text(done.output)
    return folder


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def errors_mm(rows: list[dict[str, str]]) -> list[float]:
    """Return how far poses are from the truth, from the first frame's pose."""
    return [
        1000.0 * float(np.hypot(float(row["x"]) - pose.x, float(row["y"]) - pose.y))
        for row, pose in zip(rows, TRUTH, strict=True)
    ]


def test_the_stream_is_mapped_as_its_recording_is(
    mapped: Path, calibration: Path, tmp_path: Path
) -> None:
    poses = mapped / "map" / "poses.csv"
    assert max(errors_mm(rows_of(poses))) < 1.0
    assert (mapped / "map" / "mosaic.png").exists()
    assert "5 frames used" in (mapped / "output.txt").read_text()
    done = slam("stitch", mapped / "kept", "-c", calibration, "-o", tmp_path / "again")
    assert done.exit_code == 0, done.output
    for name in ("poses.csv", "map.slam", "mosaic.png"):
        assert (tmp_path / "again" / name).read_bytes() == (mapped / "map" / name).read_bytes()


def test_the_page_has_the_picture_the_map_and_the_pose(
    mapped: Path, pictures: list[np.ndarray]
) -> None:
    state = json.loads((mapped / "state.json").read_text())
    assert (state["mode"], state["status"], state["placed"]) == ("mapping", "tracked", 5)
    assert state["pose"] == pytest.approx([TRUTH[4].x, TRUTH[4].y, TRUTH[4].theta], abs=1e-3)
    assert len(state["path"]) == 5
    shown = cv2.imread(str(mapped / "picture.jpg"))
    assert np.abs(shown.astype(int) - pictures[-1]).mean() < 6.0
    floor = cv2.imread(str(mapped / "floor.png"), cv2.IMREAD_UNCHANGED)
    assert floor.shape[:2] == (state["map"]["height"], state["map"]["width"])
    # Floor 30 cm ahead of the start was seen; far behind it none.
    for x, seen in ((0.3, True), (-0.5, False)):
        column = round((x - state["map"]["x_min"]) / state["map"]["scale"])
        row = round(state["map"]["y_max"] / state["map"]["scale"])
        inside = 0 <= column < floor.shape[1]
        assert (inside and bool(floor[row, column, 3])) == seen


def test_a_finished_map_is_located_in(
    mapped: Path, pictures: list[np.ndarray], tmp_path: Path
) -> None:
    port, output = free_port(), tmp_path / "poses.csv"
    given = ["--map", mapped / "map", "-o", output, "--port", port, "--no-browser"]
    with stream(pictures, port) as source:
        done = slam("live", source, *given)
    assert done.exit_code == 0, done.output
    assert "5 of 5 frames are on the map" in done.output
    assert max(errors_mm(rows_of(output))) < 1.0


def test_ctrl_c_ends_it_and_writes_the_map(
    pictures: list[np.ndarray], calibration: Path, tmp_path: Path
) -> None:
    port = free_port()

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        # It goes on until the command has ended.
        while state_of(port):
            pass

    given = ["-c", calibration, "-o", tmp_path / "map", "--port", port, "--no-browser"]
    with stream(pictures[:3], port, interrupt) as source:
        done = slam("live", source, *given)
    assert done.exit_code == 0, done.output
    assert "3 (100%)" in done.output
    assert len(rows_of(tmp_path / "map" / "poses.csv")) == 3
    # Nothing was to be recorded.
    assert [path.name for path in tmp_path.iterdir()] == ["map"]


def test_what_was_taken_is_kept_when_the_map_cannot_be_written(
    pictures: list[np.ndarray],
    calibration: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    output, port = tmp_path / "map", free_port()
    given = ["-c", calibration, "-o", output, "--port", port, "--no-browser"]

    def full(*_: object, **__: object) -> None:
        raise OutputError("cannot write map: No space left on device")

    monkeypatch.setattr("slamcli.run.live.stitch_drive", full)
    with stream(pictures[:2], port) as source:
        done = slam("live", source, *given)
    assert done.exit_code == 1
    assert f"slam stitch {output}/live_frames maps them" in done.output
    assert len(list((output / "live_frames").iterdir())) == 2
    # Refused before a camera is opened.
    again = slam("live", "97", *given)
    assert "of a live run that was cut off" in again.output
    done = slam("stitch", output / "live_frames", "-c", calibration, "-o", output)
    assert done.exit_code == 0, done.output


def test_a_folder_that_another_run_uses_or_left_is_refused_before_the_drive(
    pictures: list[np.ndarray], calibration: Path, tmp_path: Path
) -> None:
    output = tmp_path / "map"
    output.mkdir()
    given = ["-c", calibration, "-o", output, "--no-browser"]
    with stream(pictures[:1], free_port()) as source:
        with lock_on(output):
            assert "another run (process" in slam("live", source, *given).output
        checkpoint = Checkpoint(output)
        checkpoint.begin("key", resume=False, overwrite=False)
        checkpoint.save({}, 3, 9)
        assert "an interrupted run of other frames" in slam("live", source, *given).output


def test_poses_are_written_when_the_recording_fails(
    mapped: Path, pictures: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, output, keep = free_port(), tmp_path / "poses.csv", Recording.keep

    def full(recording: Recording, shot: Shot, index: int) -> FrameFile:
        if index == 2:
            raise OutputError("cannot write a.jpg: No space left on device")
        return keep(recording, shot, index)

    monkeypatch.setattr(Recording, "keep", full)
    given = ["--map", mapped / "map", "-o", output, "--record", tmp_path / "kept"]
    with stream(pictures[:3], port) as source:
        done = slam("live", source, *given, "--port", port, "--no-browser")
    assert done.exit_code == 1
    assert "No space left" in done.output
    assert len(rows_of(output)) == 2


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("97", "cannot open the camera 97; is it connected"),
        ("/dev/video97", "is no live camera"),
        (__file__, "slam stitch takes files"),
        ("/dev/null", "cannot open the camera /dev/null"),
        ("http://127.0.0.1:9/video.mjpg", "does it run"),
    ],
)
def test_what_is_no_camera_is_one_line(source: str, reason: str, tmp_path: Path) -> None:
    done = slam("live", source, "-o", tmp_path / "map", "--no-browser")
    assert done.exit_code == 1
    assert done.output.startswith("Error: ")
    assert reason in done.output
    assert done.output.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_what_would_be_replaced_is_refused_before_the_drive(mapped: Path, tmp_path: Path) -> None:
    done = slam("live", "97", "-o", mapped / "map", "--no-browser")
    assert "already has map.slam" in done.output
    port = free_port()
    with stream([np.zeros((48, 64, 3), np.uint8)], port) as source:
        given = ["-o", tmp_path / "map", "--port", port, "--no-browser"]
        done = slam("live", source, *given, "--record", mapped / "kept")
        assert "give --record a new folder" in done.output
        done = slam("live", source, *given, "--map", mapped / "map")
        assert "is for 320x240 images, but the camera gives 64x48" in done.output


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_page_answers_in_a_browser(
    pictures: list[np.ndarray], calibration: Path, tmp_path: Path
) -> None:
    port = free_port()
    found: dict[str, object] = {}

    def look() -> None:
        with browser(tmp_path / "profile") as page:
            page.open(f"http://127.0.0.1:{port}/")
            page.wait("floor !== null && document.getElementById('picture').naturalWidth > 0")
            box = page.run("(b => [b.x, b.y, b.width, b.height])(canvas.getBoundingClientRect())")
            page.click(box[0] + 0.5 * box[2], box[1] + 0.5 * box[3])
            page.wait("document.getElementById('cursor').innerText !== ''")
            page.run("document.getElementById('in').click()")
            found["status"] = page.run("document.getElementById('status').innerText")
            found["cursor"] = page.run("document.getElementById('cursor').innerText")
            found["alpha"] = page.run(
                "pen.getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data[3]"
            )
            page.screenshot(tmp_path / "page.png")
            found["errors"], found["requests"] = page.errors, page.requests

    given = ["-c", calibration, "-o", tmp_path / "map", "--port", port, "--no-browser"]
    with stream(pictures, port, look) as source:
        done = slam("live", source, *given)
    assert done.exit_code == 0, done.output
    assert found["status"] == "tracked"
    assert str(found["cursor"]).startswith("x ")
    assert found["alpha"] == 255
    assert found["errors"] == []
    requests = found["requests"]
    assert isinstance(requests, list)
    assert all(url.startswith(f"http://127.0.0.1:{port}/") for url in requests)
