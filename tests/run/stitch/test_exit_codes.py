"""The exit code of `slam stitch`, and the line that gives its reason."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import contents, slam

from slamcli.core.config import MapperOptions, PaintOptions, ProductOptions
from slamcli.core.errors import OutputError
from slamcli.core.exit_codes import ExitCode
from slamcli.run.command_report import Report
from slamcli.run.session.session import Session
from slamcli.run.stitch import resume, stitch
from slamcli.run.stitch.options import StitchOptions

COARSE = ("--metres-per-pixel", "0.004")
OPTIONS = StitchOptions(MapperOptions(), products=ProductOptions(PaintOptions(0.004)))


@pytest.fixture
def frames(samples_folder: Path, tmp_path: Path) -> Path:
    """Three frames of the sample with their calibration, and one that is no picture."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in range(3):
        shutil.copy(samples_folder / "course" / "frames" / f"{index:04d}.jpg", folder)
    shutil.copy(samples_folder / "course" / "camera.yaml", folder / "calibration.yaml")
    (folder / "0003.jpg").write_bytes(b"")
    return folder


def test_lost_frames_are_incomplete_when_most_are_or_strictly(frames: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    result = slam("stitch", frames, "-o", output, *COARSE)
    assert result.exit_code == ExitCode.DONE, result.output
    assert "incomplete" not in result.output
    result = slam("stitch", frames, "-o", output, *COARSE, "--strict", "--overwrite")
    assert result.exit_code == ExitCode.INCOMPLETE
    assert "incomplete: 3 of 4 placed\n" in result.output
    for index in range(4, 8):
        (frames / f"{index:04d}.jpg").write_bytes(b"")
    result = slam("stitch", frames, "-o", output, *COARSE, "--overwrite")
    assert result.exit_code == ExitCode.INCOMPLETE
    assert "incomplete: 3 of 8 placed\n" in result.output
    assert (output / "mosaic.png").is_file()


def test_a_stitch_that_places_no_frame_is_an_error(tmp_path: Path) -> None:
    for index in range(2):
        black = np.zeros((240, 320, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{index}.png"), black)
    result = slam("stitch", tmp_path, "-o", tmp_path / "out")
    assert result.exit_code == ExitCode.ERROR, result.output
    assert "placed       0 (0%)" in result.output


def stitched(frames: Path, output: Path, session: Session, **changes: bool) -> Report:
    options = StitchOptions(OPTIONS.mapper, products=OPTIONS.products, **changes)
    return stitch([frames], None, output, options, overwrite=False, session=session)


@pytest.mark.parametrize("workers", [1, 2])
def test_frames_that_vanish_before_they_are_painted_are_named(
    frames: Path, tmp_path: Path, workers: int
) -> None:
    def progress(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("locating", total):
            (frames / "0001.jpg").unlink()

    report = stitched(frames, tmp_path / "out", Session(workers, progress=progress))
    assert report.exit_code == ExitCode.INCOMPLETE
    assert report.lines[1:4] == (
        "incomplete: 1 frame (0001.jpg) not painted: vanished or changed since they were located",
        "put them back, and --resume continues from what was located before",
        "frames       4",
    )
    assert (tmp_path / "out" / "mosaic.png").is_file()


def damage(frames: Path, kind: str) -> None:
    """Change a frame: its time is that of before where a copy may have kept it."""
    path = frames / "0001.jpg"
    data, status = path.read_bytes(), path.stat()
    if kind == "removed":
        path.unlink()
    elif kind == "truncated":
        path.write_bytes(data[: len(data) // 2])
    else:
        path.write_bytes((frames / "0002.jpg").read_bytes())
        os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.mark.parametrize("stage", ["locating 4", "comparing light 2"])
@pytest.mark.parametrize("kind", ["removed", "truncated", "replaced"])
def test_a_run_whose_frames_change_goes_on_when_they_are_back(
    frames: Path, tmp_path: Path, kind: str, stage: str
) -> None:
    stitched(frames, tmp_path / "whole", Session())
    kept, cut = tmp_path / "kept", tmp_path / "cut"
    shutil.copytree(frames, kept)

    def progress(now: str, done: int, _total: int) -> None:
        if f"{now} {done}" == stage:
            damage(frames, kind)

    report = stitched(frames, cut, Session(progress=progress))
    assert report.exit_code == ExitCode.INCOMPLETE
    assert "incomplete: 1 frame (0001.jpg) not painted" in report.lines[1]
    shutil.copy2(kept / "0001.jpg", frames)
    notices: list[str] = []
    report = stitched(frames, cut, Session(notify=notices.append), resume=True)
    assert notices[0] == "resumed: 4 of 4 frames had been located"
    assert report.exit_code == ExitCode.DONE
    assert contents(cut) == contents(tmp_path / "whole")


def test_a_run_whose_frames_vanish_in_its_first_seconds_keeps_what_it_located_before(
    frames: Path, tmp_path: Path
) -> None:
    stitched(frames, tmp_path / "whole", Session())
    kept, cut = tmp_path / "kept", tmp_path / "cut"
    shutil.copytree(frames, kept)

    def progress(stage: str, done: int, _total: int) -> None:
        # The last one is not read ahead yet.
        if (stage, done) == ("locating", 1):
            (frames / "0003.jpg").unlink()

    report = stitched(frames, cut, Session(progress=progress))
    assert report.exit_code == ExitCode.INCOMPLETE
    assert "incomplete: 1 frame (0003.jpg) vanished before being located" in report.lines
    shutil.copy2(kept / "0003.jpg", frames)
    notices: list[str] = []
    report = stitched(frames, cut, Session(notify=notices.append), resume=True)
    assert report.exit_code == ExitCode.DONE
    assert notices[0] == "resumed: 3 of 4 frames had been located"
    assert contents(cut) == contents(tmp_path / "whole")


def test_ctrl_c_is_130_in_a_command_that_cannot_stop_halfway(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pressed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slamcli.run.warp.warp", pressed)
    result = slam("warp", frames, "-o", tmp_path / "views")
    assert result.exit_code == ExitCode.INTERRUPTED
    assert result.output == "interrupted\n"


def test_a_state_of_another_layout_is_not_resumed(
    frames: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(stage: str, done: int, total: int) -> None:
        if stage == "painting":
            raise SystemExit

    def cut_off() -> None:
        with pytest.raises(SystemExit):
            stitched(frames, tmp_path / "out", Session(progress=killed))

    notices: list[str] = []
    cut_off()
    stitched(frames, tmp_path / "out", Session(notify=notices.append), resume=True, strict=True)
    assert notices[0] == "resumed: 4 of 4 frames had been located"
    shutil.rmtree(tmp_path / "out")
    cut_off()
    monkeypatch.setattr(resume, "_STATE_LAYOUT", 0)
    with pytest.raises(OutputError, match="an interrupted run of other frames or options"):
        stitched(frames, tmp_path / "out", Session(), resume=True)
