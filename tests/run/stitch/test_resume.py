"""A run that was cut off: what is left of it, and how it is resumed."""

from __future__ import annotations

import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import contents, slam

from slamcli.core.config import MapperOptions, PaintOptions, ProductOptions
from slamcli.core.errors import OutputError
from slamcli.io.checkpoints import Checkpoint, run_key
from slamcli.run.command_report import Report
from slamcli.run.session.session import Session
from slamcli.run.stitch import resume, stitch
from slamcli.run.stitch.options import StitchOptions

COARSE = ("--metres-per-pixel", "0.004")


def command(drive: Path, output: Path, *more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "slamcli",
        "stitch",
        str(drive),
        "-o",
        str(output),
        *COARSE,
        *more,
    ]


@pytest.mark.parametrize("stage", ["locating 3/5", "painting 2/"])
def test_a_killed_run_goes_on_to_the_same_bytes(drive: Path, tmp_path: Path, stage: str) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert slam("stitch", drive, "-o", whole, *COARSE).exit_code == 0
    process = subprocess.Popen(command(drive, cut), stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(stage):
            break
    process.kill()
    process.wait()
    process.stderr.close()
    assert not (cut / "poses.csv").exists()
    result = slam("stitch", drive, "-o", cut, "--resume", *COARSE)
    assert result.exit_code == 0, result.output
    if stage.startswith("painting"):
        assert "5 of 5 frames had been located" in result.output
        assert "locating" not in result.output
    assert contents(cut) == contents(whole)


def test_ctrl_c_ends_with_what_is_there_and_can_be_gone_on_with(
    drive: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut"
    with subprocess.Popen(
        command(drive, cut), stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert process.stdout is not None
        for line in process.stderr:
            if line.startswith("locating 2/5"):
                os.kill(process.pid, signal.SIGINT)
                break
        process.stderr.read()
        printed = process.stdout.read()
    assert process.returncode == 130
    assert "interrupted" in printed
    # One line for all that were not reached.
    assert re.search(r"not reached +\d frames? \(\d{4}\.\w+", printed)
    assert "not reached: interrupted" not in printed
    rows = (cut / "poses.csv").read_text().splitlines()
    assert len(rows) == 6
    assert "not reached: interrupted" in rows[-1]
    assert cv2.imread(str(cut / "mosaic.png"), cv2.IMREAD_UNCHANGED)[..., 3].any()
    result = slam("stitch", drive, "-o", cut, "--resume", *COARSE)
    assert result.exit_code == 0, result.output
    assert "placed       5 (100%)" in result.output
    assert not (cut / ".resume").exists()


def cut_off(drive: Path, output: Path, stage: str, **changes: bool) -> None:
    """Run until a line of the progress, as a killed program would."""

    def killed(now: str, done: int, _total: int) -> None:
        if f"{now} {done}" == stage:
            raise SystemExit

    with pytest.raises(SystemExit):
        stitched(drive, output, Session(progress=killed), **changes)


def stitched(
    drive: Path, output: Path, session: Session, *, overwrite: bool = False, **changes: bool
) -> Report:
    options = StitchOptions(MapperOptions(), products=ProductOptions(PaintOptions(0.004)))
    return stitch(
        [drive], None, output, replace(options, **changes), overwrite=overwrite, session=session
    )


@pytest.fixture
def saved_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """A state is saved after every frame."""
    monkeypatch.setattr(resume, "_SAVE_SECONDS", 0.0)
    monkeypatch.setattr(resume, "_MAX_SAVE_SHARE", 1e9)


@pytest.mark.usefixtures("saved_often")
def test_a_run_goes_on_from_any_frame_to_the_same_bytes(drive: Path, tmp_path: Path) -> None:
    stitched(drive, tmp_path / "whole", Session())
    cut, notices = tmp_path / "cut", list[str]()
    for number in range(2, 6):
        resumed = Session(notify=notices.append)
        cut_off(drive, cut, f"locating {number}", resume=number > 2)
        shutil.copytree(cut, tmp_path / str(number))
        stitched(drive, tmp_path / str(number), resumed, resume=True)
        assert f"resumed: {number - 1} of 5 frames had been located" in notices
        assert contents(tmp_path / str(number)) == contents(tmp_path / "whole")


@pytest.mark.usefixtures("saved_often")
def test_an_interrupted_run_is_not_thrown_away_by_running_it_again(
    drive: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut"
    cut_off(drive, cut, "locating 4")
    before = contents(cut)
    result = slam("stitch", drive, "-o", cut, *COARSE)
    assert result.exit_code == 1
    assert result.output == (
        f"Error: {cut} has an interrupted run, 3 of 5 located: --resume to go on, or --overwrite "
        "to begin anew\n"
    )
    result = slam("stitch", drive, "-o", cut, *COARSE, "--no-loops", "--resume")
    assert result.exit_code == 1
    assert "an interrupted run of other frames or options, 3 of 5 located" in result.output
    assert contents(cut) == before
    result = slam("stitch", drive, "-o", cut, *COARSE, "--overwrite")
    assert result.exit_code == 0, result.output
    assert "resumed" not in result.output
    assert not (cut / ".resume").exists()
    # A finished run is not resumed, and not replaced either.
    result = slam("stitch", drive, "-o", cut, *COARSE, "--resume")
    assert "already has" in result.output


@pytest.mark.usefixtures("saved_often")
def test_a_full_disk_keeps_the_state(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OutputError("cannot write: No space left on device")

    cut = tmp_path / "cut"
    with monkeypatch.context() as patch:
        patch.setattr("slamcli.run.stitch.write_poses", full)
        with pytest.raises(OutputError):
            stitched(drive, cut, Session())
    assert not list(cut.glob(".partial-*"))
    result = slam("stitch", drive, "-o", cut, *COARSE, "--resume")
    assert result.exit_code == 0, result.output
    assert "5 of 5 frames had been located" in result.output


@pytest.mark.usefixtures("saved_often")
@pytest.mark.parametrize("damage", ["one byte", "cut", "empty", "both"])
def test_a_damaged_state_is_named_and_the_one_before_it_is_used(
    drive: Path, tmp_path: Path, damage: str
) -> None:
    stitched(drive, tmp_path / "whole", Session())
    cut = tmp_path / "cut"
    cut_off(drive, cut, "painting 2")
    state = cut / ".resume" / "mapper.state"
    data = state.read_bytes()
    damaged = {"cut": data[: len(data) // 2], "empty": b""}.get(damage, data[:-1] + b"?")
    state.write_bytes(damaged)
    progress = "4 of 5 located"
    if damage == "both":
        (cut / ".resume" / "mapper.earlier").write_bytes(damaged)
        progress = "its saved state is damaged"
    assert f"{progress}: --resume" in slam("stitch", drive, "-o", cut, *COARSE).output
    notices: list[str] = []
    stages: list[str] = []
    stitched(
        drive,
        cut,
        Session(progress=lambda s, d, _: stages.append(f"{s} {d}"), notify=notices.append),
        resume=True,
    )
    assert notices[0].startswith(f"{state} is damaged: ")
    assert notices[0].endswith("; the run goes on without it")
    assert ("resumed: 4 of 5 frames had been located" in notices) == (damage != "both")
    assert "painting 1" not in stages
    assert contents(cut) == contents(tmp_path / "whole")


@pytest.mark.usefixtures("saved_often")
def test_a_damaged_tile_is_painted_again(drive: Path, tmp_path: Path) -> None:
    stitched(drive, tmp_path / "whole", Session())
    for number, damage in enumerate((b"", b"PK\3\4", None)):
        cut = tmp_path / str(number)
        cut_off(drive, cut, "painting 2")
        tile = next(iter((cut / ".resume" / "tiles").rglob("*.npz")))
        data = tile.read_bytes()
        middle = len(data) // 2
        tile.write_bytes(data[:middle] + b"????" + data[middle + 4 :] if damage is None else damage)
        stitched(drive, cut, Session(), resume=True)
        assert contents(cut) == contents(tmp_path / "whole")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_request_to_end_is_served_as_ctrl_c(
    drive: Path, tmp_path: Path, number: signal.Signals
) -> None:
    cut = tmp_path / "cut"
    with subprocess.Popen(command(drive, cut), stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.startswith("locating 2/5"):
                os.kill(process.pid, number)
                break
        said = process.stderr.read()
    assert process.returncode == 130
    assert said.count("interrupted: stops after this step") == 1
    assert (cut / ".resume").is_dir()
    assert (cut / "poses.csv").is_file()
    assert not list(cut.glob(".partial-*"))


def test_a_request_to_end_a_command_that_cannot_stop_halfway_leaves_nothing(
    drive: Path, tmp_path: Path
) -> None:
    views = tmp_path / "views"
    words = [sys.executable, "-m", "slamcli", "warp", str(drive), "-o", str(views)]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        process.stderr.readline()
        os.kill(process.pid, signal.SIGTERM)
        said = process.stderr.read()
    assert process.returncode == 130
    assert said.splitlines().count("interrupted") == 1
    assert not views.exists()


def test_a_state_of_another_run_is_not_gone_on_with(tmp_path: Path) -> None:
    first = run_key("a", [tmp_path])
    checkpoint = Checkpoint(tmp_path)
    assert not checkpoint.begin(first, resume=False, overwrite=False)
    checkpoint.save({"frames": np.array([3])}, 3, 4)
    checkpoint = Checkpoint(tmp_path)
    assert checkpoint.begin(first, resume=True, overwrite=False)
    state, faults = checkpoint.load()
    assert state is not None
    assert state["frames"].tolist() == [3]
    assert not faults
    other = run_key("b", [tmp_path])
    with pytest.raises(OutputError, match="3 of 4 located"):
        Checkpoint(tmp_path).begin(other, resume=True, overwrite=False)
    assert not Checkpoint(tmp_path).begin(other, resume=True, overwrite=True)
    assert not checkpoint.folder.exists()


def fail_without_located_frames(output: Path, *, painted: bool) -> None:
    with Checkpoint(output) as checkpoint:
        checkpoint.begin("key", resume=False, overwrite=False)
        checkpoint.save({}, 0, 4)
        if painted:
            checkpoint.tiles("options").mkdir(parents=True)
        raise OutputError("a fault")


def test_a_state_without_located_frames_is_resumed_and_refuses_nothing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="a fault"):
        fail_without_located_frames(tmp_path, painted=False)
    assert not (tmp_path / ".resume").exists()
    with pytest.raises(OutputError, match="a fault"):
        fail_without_located_frames(tmp_path, painted=True)
    again = Checkpoint(tmp_path)
    assert again.begin("key", resume=True, overwrite=False)
    assert again.load() == ({}, [])
    assert again.tiles("options").exists()
    assert not Checkpoint(tmp_path).begin("other", resume=False, overwrite=False)
    assert not again.folder.exists()


def test_a_state_is_no_pickle(tmp_path: Path) -> None:
    checkpoint = Checkpoint(tmp_path)
    checkpoint.begin("key", resume=False, overwrite=False)
    checkpoint.save({}, 0, 1)
    checkpoint.state_path.write_bytes(pickle.dumps(time.sleep))
    state, faults = checkpoint.load()
    assert state is None
    assert "is damaged" in faults[0]
