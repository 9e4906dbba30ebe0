from __future__ import annotations

import os
from pathlib import Path

import pytest

from slamcli.core.errors import OutputError
from slamcli.io.files import write_text
from slamcli.io.outputs import output_folder, refuse_existing


def test_a_failed_run_leaves_nothing_behind(tmp_path: Path) -> None:
    folder = tmp_path / "out"

    def stop_halfway() -> None:
        with output_folder(folder, ("*.csv",), inputs=(), overwrite=False) as staging:
            (staging / "poses.csv").write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        stop_halfway()
    assert not folder.exists()


def test_earlier_results_are_kept_unless_told(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("old")
    (tmp_path / "stale.csv").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    with (
        pytest.raises(OutputError, match="--overwrite"),
        output_folder(tmp_path, ("*.csv",), inputs=(), overwrite=False),
    ):
        pass
    with output_folder(tmp_path, ("*.csv",), inputs=(), overwrite=True) as staging:
        (staging / "poses.csv").write_text("new")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "poses.csv"]
    assert (tmp_path / "poses.csv").read_text() == "new"


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    blocking = tmp_path / "taken"
    blocking.write_text("")
    with (
        pytest.raises(OutputError, match="name a folder"),
        output_folder(blocking, (), inputs=(), overwrite=True),
    ):
        pass
    with pytest.raises(OutputError, match="cannot write"):
        write_text(blocking / "poses.csv", "")
    with pytest.raises(OutputError, match="exists"):
        refuse_existing(blocking, inputs=(), overwrite=False)


def test_an_output_over_an_input_a_link_or_a_device_is_refused(tmp_path: Path) -> None:
    frame = tmp_path / "frame.png"
    frame.write_text("mine")
    link, dangling = tmp_path / "link.png", tmp_path / "dangling.png"
    link.symlink_to(frame)
    dangling.symlink_to(tmp_path / "nowhere")
    with pytest.raises(OutputError, match="is an input of this command"):
        refuse_existing(frame, inputs=[None, link], overwrite=True)
    for path in (link, dangling):
        with pytest.raises(OutputError, match="it is a link; name "):
            refuse_existing(path, inputs=(), overwrite=True)
    with pytest.raises(OutputError, match="a device"):
        refuse_existing(Path("/dev/null"), inputs=(), overwrite=True)
    refuse_existing(frame, inputs=[tmp_path / "other.png"], overwrite=True)
    assert frame.read_text() == "mine"


def test_a_folder_of_outputs_replaces_no_input_and_no_link(tmp_path: Path) -> None:
    def write(folder: Path, *inputs: Path) -> None:
        with output_folder(folder, ("*.csv", "matches"), inputs=inputs, overwrite=True):
            pass

    (tmp_path / "matches").mkdir()
    for name in ("poses.csv", "matches/0.png", "free.txt"):
        (tmp_path / name).write_text("mine")
    for name in ("poses.csv", "matches/0.png"):
        with pytest.raises(OutputError, match="is an input of this command"):
            write(tmp_path, tmp_path / "free.txt", tmp_path / name)
    linked = tmp_path / "linked"
    linked.symlink_to(tmp_path)
    with pytest.raises(OutputError, match="it is a link"):
        write(linked)
    (tmp_path / "more.csv").symlink_to(tmp_path / "free.txt")
    with pytest.raises(OutputError, match="it is a link"):
        write(tmp_path)
    for name in ("poses.csv", "matches/0.png", "more.csv"):
        assert (tmp_path / name).read_text() == "mine"


def test_the_staging_folder_of_a_killed_run_is_deleted_by_the_next(tmp_path: Path) -> None:
    (tmp_path / ".partial-old").mkdir()
    with output_folder(tmp_path, (), inputs=(), overwrite=False) as staging:
        (staging / "poses.csv").write_text("")
    assert [path.name for path in tmp_path.iterdir()] == ["poses.csv"]


def test_results_are_on_the_disk_before_they_are_renamed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (calls.append("sync"), fsync(number)))
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("rename"), replace(*paths)))
    write_text(tmp_path / "a.csv", "")
    assert calls == ["sync", "rename", "sync"]
    calls.clear()
    with output_folder(tmp_path / "out", (), inputs=(), overwrite=False) as staging:
        write_text(staging / "b.csv", "")
        assert calls == ["rename"]
    assert calls == ["rename", "sync", "rename", "sync"]
