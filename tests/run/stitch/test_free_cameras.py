"""`slam stitch` of frames in no order, and of a known lens without a calibration."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from command_line import slam
from flights import FOCAL, SIZE, floor_picture, nadir_states, photographs
from trajectories import read_rows

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.lens import image_centre

COLUMN, ROW = image_centre(SIZE)
MATRIX = [FOCAL, 0.0, COLUMN, 0.0, FOCAL, ROW, 0.0, 0.0, 1.0]
LENS = f"""
image_width: {SIZE[0]}
image_height: {SIZE[1]}
distortion_model: plumb_bob
camera_matrix:
  rows: 3
  cols: 3
  data: {MATRIX}
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 0.0, 0.0, 0.0, 0.0]
"""


def bent(picture: np.ndarray) -> np.ndarray:
    """Return a picture as a lens with k1 = -0.1 sees it."""
    columns, rows = np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))
    matrix = np.array(
        [[FOCAL, 0.0, image_centre(SIZE)[0]], [0.0, FOCAL, image_centre(SIZE)[1]], [0, 0, 1.0]]
    )
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    own = cv2.undistortPoints(pixels[:, None], matrix, np.array([-0.1, 0, 0, 0, 0]), P=matrix)
    read = own.reshape(SIZE[1], SIZE[0], 2).astype(np.float32)
    return cv2.remap(picture, read[..., 0], read[..., 1], cv2.INTER_CUBIC)


def error_pixels(folder: Path, states: Float64Array) -> float:
    """Return the root mean square distance of the frames' middles after one similarity."""
    rows = read_rows(folder / "poses.csv")
    assert [row["status"] for row in rows] == ["tracked"] * len(states)
    z = np.array([float(row["x"]) + 1j * float(row["y"]) for row in rows])
    w = states[:, :2] @ [1.0, 1.0j]
    z, w = z - z.mean(), w - w.mean()
    return float(np.sqrt(np.mean(np.abs(np.vdot(z, w) / np.vdot(z, z) * z - w) ** 2)))


def test_a_known_lens_without_a_calibration(tmp_path: Path) -> None:
    states = nadir_states(2, 3, np.random.default_rng(1))
    (tmp_path / "frames").mkdir()
    for number, picture in enumerate(photographs(floor_picture(), states)):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), bent(picture))
    (tmp_path / "lens.yaml").write_text(LENS)
    known = ("--intrinsics", tmp_path / "lens.yaml")
    result = slam("stitch", tmp_path / "frames", "-o", tmp_path / "map", *known, "--unordered")
    assert result.exit_code == 0, result.output
    assert error_pixels(tmp_path / "map", states) < 0.3
    rows = read_rows(tmp_path / "map" / "poses.csv")
    pitch = [math.degrees(float(row["rocking_pitch"])) for row in rows]
    np.testing.assert_allclose(pitch, np.degrees(states[:, 4]), atol=0.5)


def test_what_a_known_lens_and_no_order_exclude(tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(2):
        cv2.imwrite(str(frames / f"{number}.png"), np.full((*SIZE[::-1], 3), 90, np.uint8))
    (tmp_path / "odometry.csv").write_text("stamp,x,y,heading\n0,0,0,0\n1,1,0,0\n")
    sensors = ("--odometry", tmp_path / "odometry.csv", "--frame-rate", "1")
    result = slam("stitch", frames, "-o", tmp_path / "map", "--unordered", *sensors)
    assert result.exit_code == 1
    assert "--unordered works by the frames alone" in result.output
    (tmp_path / "lens.yaml").write_text(LENS.replace(f"width: {SIZE[0]}", "width: 999"))
    result = slam("stitch", frames, "-o", tmp_path / "map", "--intrinsics", tmp_path / "lens.yaml")
    assert result.exit_code == 1
    assert "but the frames have" in result.output
