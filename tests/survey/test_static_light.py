"""A lamp's pattern that stays in the picture while the floor moves."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam
from trajectories import read_rows

SIZE = (320, 240)


def test_a_lamps_pattern_is_taken_out_before_frames_are_registered(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    floor = cv2.GaussianBlur(generator.normal(0.0, 1.0, (500, 900)), (0, 0), 2.0)
    floor = 120.0 + 9.0 * floor / floor.std()
    lamp = cv2.GaussianBlur(generator.normal(0.0, 1.0, SIZE[::-1]), (0, 0), 9.0)
    lamp = 1.0 + 0.4 * np.clip(lamp / (2.0 * lamp.std()), -1.0, 1.0)
    frames = tmp_path / "frames"
    frames.mkdir()
    places = [(40 + 55 * number, 60 + 12 * (number % 3)) for number in range(9)]
    for number, (left, top) in enumerate(places):
        part = floor[top : top + SIZE[1], left : left + SIZE[0]] * lamp
        part += generator.normal(0.0, 0.5, part.shape)
        cv2.imwrite(str(frames / f"{number}.png"), np.clip(part, 0, 255).astype(np.uint8))
    result = slam("stitch", frames, "-o", tmp_path / "map")
    assert result.exit_code == 0, result.output
    rows = read_rows(tmp_path / "map" / "poses.csv")
    assert [row["status"] for row in rows] == ["tracked"] * 9
    assert {row["fragment"] for row in rows} == {"0"}
    found = np.array([[float(row["x"]), float(row["y"])] for row in rows])
    truth = np.array([[left - places[0][0], places[0][1] - top] for left, top in places])
    assert np.abs(found - truth).max() < 1.5


@pytest.mark.slow
def test_vignetting_alone_makes_no_map(tmp_path: Path) -> None:
    generator = np.random.default_rng(4)
    down, across = np.mgrid[: SIZE[1], : SIZE[0]] - np.array(SIZE[::-1])[:, None, None] / 2
    vignetting = 1.0 - 0.7 * (down**2 + across**2) / (SIZE[0] / 2) ** 2
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(6):
        # Four plain floors with nothing in common, and two with texture of their own.
        grain, gray = (25.0, 4.0) if number < 4 else (2.0, 20.0)
        floor = cv2.GaussianBlur(generator.normal(0.0, 1.0, SIZE[::-1]), (0, 0), grain)
        part = (90.0 + gray * floor / floor.std()) * vignetting
        part += generator.normal(0.0, 1.0, part.shape)
        cv2.imwrite(str(frames / f"{number}.png"), np.clip(part, 0, 255).astype(np.uint8))
    result = slam("stitch", frames, "-o", tmp_path / "map")
    assert result.exit_code == 1, result.output
    assert not (tmp_path / "map" / "mosaic.png").exists()
