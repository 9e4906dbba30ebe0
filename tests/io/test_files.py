from __future__ import annotations

from pathlib import Path

import pytest

from slamcli.core.errors import OutputError
from slamcli.io.files import output_folder, refuse_existing, write_text


def test_a_failed_run_leaves_nothing_behind(tmp_path: Path) -> None:
    folder = tmp_path / "out"

    def stop_halfway() -> None:
        with output_folder(folder, ("*.csv",), overwrite=False) as staging:
            (staging / "poses.csv").write_text("half")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        stop_halfway()
    assert list(folder.iterdir()) == []


def test_earlier_results_are_kept_unless_told(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("old")
    (tmp_path / "stale.csv").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    with (
        pytest.raises(OutputError, match="--overwrite"),
        output_folder(tmp_path, ("*.csv",), overwrite=False),
    ):
        pass
    with output_folder(tmp_path, ("*.csv",), overwrite=True) as staging:
        (staging / "poses.csv").write_text("new")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine.txt", "poses.csv"]
    assert (tmp_path / "poses.csv").read_text() == "new"


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    blocking = tmp_path / "taken"
    blocking.write_text("")
    with (
        pytest.raises(OutputError, match="name a folder"),
        output_folder(blocking, (), overwrite=True),
    ):
        pass
    with pytest.raises(OutputError, match="cannot write"):
        write_text(blocking / "poses.csv", "")
    with pytest.raises(OutputError, match="exists"):
        refuse_existing(blocking, overwrite=False)
