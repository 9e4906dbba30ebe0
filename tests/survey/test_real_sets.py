"""Real frames of other people's planes, without a calibration or an option."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import slam
from trajectories import read_rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "maps"),
    [("seabed1", [8]), ("seabed6", [8]), ("seneca", [25]), ("cfn", [8, 3])],
)
def test_every_frame_is_in_its_map(
    data_folder: Path, tmp_path: Path, name: str, maps: list[int]
) -> None:
    result = slam("stitch", data_folder / "real" / name, "-o", tmp_path / "map")
    assert result.exit_code == 0, result.output
    rows = read_rows(tmp_path / "map" / "poses.csv")
    fragments = [row["fragment"] for row in rows]
    assert [fragments.count(str(number)) for number in range(len(maps))] == maps
    assert len(rows) == sum(maps)
