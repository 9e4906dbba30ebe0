"""Stamps in names: read rightly where they are times, and not at all where they are counters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from slamcli.io.frames import list_frames
from slamcli.io.stamps import stamps_of_names

SECONDS = 1_700_000_000


@pytest.mark.parametrize(
    ("names", "seconds"),
    [
        (["1700000000.5", "1700000000.25", "1700000001"], [0.5, 0.25, 1.0]),
        (["1700000000", "1700000002"], [0.0, 2.0]),
        (["1700000000250", "1700000000500"], [0.25, 0.5]),
        (["1700000000250001", "1700000000500000"], [0.250001, 0.5]),
        (["left_1700000000250001234", "left_1700000000500000000"], [0.250001, 0.5]),
        (["999999999.5", "1000000000.5"], [999999999.5 - SECONDS, 1000000000.5 - SECONDS]),
        (["0.000000", "0.033333", "12.500000"], [-SECONDS, 0.033333 - SECONDS, 12.5 - SECONDS]),
    ],
)
def test_times_are_read(names: list[str], seconds: list[float]) -> None:
    found = stamps_of_names(names)
    assert found is not None
    assert np.subtract(found.seconds, SECONDS).tolist() == pytest.approx(seconds, abs=2e-6)


@pytest.mark.parametrize(
    "names",
    [
        ["0000000000", "0000000001"],
        ["0000000123"],
        ["9000000000", "9000000001"],
        ["frame1", "frame2"],
        ["1700000000.5", "plan"],
        ["left_1700000000.5", "right_1700000000.5"],
        ["1700000000", "1700000000000"],
        ["1.1", "1.2"],
        ["0.100", "0.1"],
        ["1700000000.50", "1700000000.5"],
        ["17000000002500", "17000000005000"],
        ["1700000000_2", "1700000000_3"],
        [],
    ],
)
def test_what_is_no_plausible_series_has_no_stamps(names: list[str]) -> None:
    assert stamps_of_names(names) is None


def pictures(folder: Path, *names: str) -> Path:
    for name in names:
        Image.new("L", (32, 32), 90).save(folder / name)
    return folder


def test_frames_are_in_the_order_of_their_stamps(tmp_path: Path) -> None:
    pictures(tmp_path, "1700000000.5.png", "1700000000.25.png", "1700000000.125.png")
    files = list_frames([tmp_path])
    assert [file.stamp for file in files] == [SECONDS + 0.125, SECONDS + 0.25, SECONDS + 0.5]


def test_files_that_are_named_keep_their_order(tmp_path: Path) -> None:
    pictures(tmp_path, "1700000000.5.png", "1700000000.25.png")
    named = [tmp_path / "1700000000.5.png", tmp_path / "1700000000.25.png"]
    assert [file.stamp for file in list_frames(named)] == [SECONDS + 0.5, SECONDS + 0.25]


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (["1700000000.png", "1700000001.png"], [0.0, 0.1]),
        (["0.000000.png", "0.500000.png"], [0.0, 0.1]),
        (["1700000000.25.png", "1700000000.5.png"], [SECONDS + 0.25, SECONDS + 0.5]),
    ],
)
def test_a_frame_rate_wins_over_doubt(
    tmp_path: Path, names: list[str], stamps: list[float]
) -> None:
    files = list_frames([pictures(tmp_path, *names)], frame_rate=10.0)
    assert [file.stamp for file in files] == stamps
