"""`slam detect`: a drawing a frame and one table."""

from __future__ import annotations

import csv

import cv2
import floor_pictures
import numpy as np
import pytest
from command_line import slam

from slamcli.core.geometry import Grid, Pose2
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import write_image


def run(*arguments):
    return slam("detect", *arguments)


def rows_of(folder):
    with (folder / "features.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.fixture
def frames(tmp_path):
    """A dark half beside a textured one, and a smaller frame of other texture."""
    folder = tmp_path / "frames"
    folder.mkdir()
    image = floor_pictures.asphalt(400)
    image[:, :200] //= 4
    write_image(folder / "f2.png", image)
    write_image(folder / "f10, dark.png", floor_pictures.asphalt(300, seed=1))
    (folder / "f11.png").write_bytes(b"no picture")
    return folder


def test_points_are_drawn_and_listed(frames, tmp_path):
    output = tmp_path / "out"
    result = run(frames, "-o", output, "--count", 300)
    assert result.exit_code == 0
    assert "f2.png: 300 ORB points" in result.stdout
    assert "skipped f11.png: " in result.stdout
    rows = rows_of(output)
    assert list(rows[0]) == ["frame", "x", "y", "size", "angle", "response", "octave"]
    assert [row["frame"] for row in rows] == ["f2.png"] * 300 + ["f10, dark.png"] * 300
    assert all(20.0 < float(row["x"]) < 380.0 for row in rows[:300])
    assert cv2.imread(str(output / "f2_keypoints.png")).shape == (422, 400, 3)
    assert not (output / "f11_keypoints.png").exists()


def test_what_was_removed_is_tinted(frames, tmp_path):
    output = tmp_path / "out"
    arguments = ("-o", output, "--clean", "--clean-threshold", 60, "--count", 40)
    assert run(frames / "f2.png", *arguments).exit_code == 0
    # Without the text above; the tint adds blue to what was cleaned and red to the border.
    shown = cv2.imread(str(output / "f2_keypoints.png"))[22:].astype(int)
    blue_minus_red = shown[..., 0] - shown[..., 2]
    assert np.median(blue_minus_red[50:350, 50:150]) > 40
    assert np.median(blue_minus_red[50:350, 250:350]) == 0
    assert np.median(blue_minus_red[50:350, 390:]) < -40
    assert all(float(row["x"]) > 190.0 for row in rows_of(output))
    assert run(frames / "f2.png", *arguments, "--no-roi", "--overwrite").exit_code == 0
    shown = cv2.imread(str(output / "f2_keypoints.png"))[22:].astype(int)
    assert np.median(shown[50:350, 390:, 0] - shown[50:350, 390:, 2]) == 0


def test_calibrated_points_are_on_the_floor(tmp_path):
    calibration = floor_pictures.forward_camera()
    grid = Grid(-0.1, 0.65, 0.0005, 2600, 2600)
    floor = np.full((2600, 2600), 90, np.uint8)
    # One small white square half a metre ahead, two decimetres to the left.
    corner = grid.pixel_from_metres @ (0.5, 0.2, 1.0)
    column, row = np.rint(corner[:2]).astype(int)
    floor[row - 40 : row + 40, column - 40 : column + 40] = 230
    photo = floor_pictures.photograph(floor, grid, calibration, Pose2())
    write_image(tmp_path / "a.png", photo)
    save_calibration(tmp_path / "calibration.yaml", calibration)
    result = run(tmp_path / "a.png", "-o", tmp_path / "out")
    assert "calibration found: " in result.stdout
    rows = rows_of(tmp_path / "out")
    assert len(rows) > 3
    places = np.array([[float(row["x_metres"]), float(row["y_metres"])] for row in rows])
    assert np.all(np.abs(places - (0.5, 0.2)) < 0.04)


def test_nothing_is_replaced_unasked_and_nothing_half_written(frames, tmp_path):
    output = tmp_path / "out"
    assert run(frames, "-o", output).exit_code == 0
    again = run(frames, "-o", output)
    assert again.exit_code == 1
    assert "--overwrite" in again.stderr
    empty = run(frames / "f11.png", "-o", tmp_path / "none")
    assert empty.exit_code == 1
    assert empty.stderr.count("\n") == 1
    assert not list((tmp_path / "none").glob("*"))
