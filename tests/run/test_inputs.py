"""The inputs of a command: the common size of the frames, and the calibration that is found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from slamcli.core.errors import InputError
from slamcli.run.inputs import open_inputs


def write(folder: Path, name: str, width: int, height: int) -> None:
    cv2.imwrite(str(folder / name), np.full((height, width), 90, np.uint8))


def test_without_a_calibration_most_frames_give_the_size(tmp_path: Path) -> None:
    write(tmp_path, "a_plan.png", 200, 100)
    for number in range(40):
        write(tmp_path, f"f{number}.png", 64, 48)
    assert open_inputs([tmp_path], None).calibration.image_size == (64, 48)


def test_two_pictures_of_different_sizes_are_those_of_the_first(tmp_path: Path) -> None:
    write(tmp_path, "a.png", 200, 100)
    write(tmp_path, "b.png", 64, 48)
    calibration = open_inputs([tmp_path / "a.png", tmp_path / "b.png"], None).calibration
    assert calibration.image_size == (200, 100)


def test_no_frame_that_can_be_read_is_an_error(tmp_path: Path) -> None:
    for number in range(40):
        (tmp_path / f"{number}.png").write_bytes(b"%PDF-1.7")
    with pytest.raises(InputError, match=r"none of the 40 frames .* 0\.png: it is a PDF file"):
        open_inputs([tmp_path], None)
    write(tmp_path, "39.png", 64, 48)
    assert open_inputs([tmp_path], None).calibration.image_size == (64, 48)
