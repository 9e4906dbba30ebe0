"""Metres for frames from above without a calibration."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slam
from trajectories import read_rows

from slamcli.core.camera.calibration import Rocking, top_down_calibration
from slamcli.core.camera.mounting import rocked
from slamcli.core.geometry import apply_homography
from slamcli.io.control_points import read_control_points
from slamcli.run.stitch.ground_scale import from_first

METRES_PER_PIXEL = 0.002
STEP_PIXELS = 40
HEADER = "frame,column,row,x,y\n"


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of frames that shift to the right by 40 pixels."""
    generator = np.random.default_rng(3)
    floor = np.zeros((400, 600), np.float32)
    for size in (2, 5, 14, 40):
        noise = generator.standard_normal((400 // size + 2, 600 // size + 2)).astype(np.float32)
        floor += cv2.resize(noise, (600, 400), interpolation=cv2.INTER_CUBIC)
    picture = np.asarray(cv2.normalize(floor, None, 0, 255, cv2.NORM_MINMAX), np.uint8)
    folder = tmp_path_factory.mktemp("frames")
    for number in range(4):
        left = 50 + STEP_PIXELS * number
        cv2.imwrite(str(folder / f"{number}.png"), picture[100:292, left : left + 256])
    return folder


def steps(folder: Path) -> list[float]:
    rows = read_rows(folder / "poses.csv")
    places = [complex(float(row["x"]), float(row["y"])) for row in rows]
    return [abs(b - a) for a, b in pairwise(places)]


def test_control_points_scale_and_turn_the_map_and_name_the_outlier(
    frames: Path, tmp_path: Path
) -> None:
    # East is up in the pictures: turned by a quarter.
    lines = []
    for frame, column, row in ((0, 20, 30), (1, 200, 40), (2, 60, 150), (3, 220, 170), (0, 99, 99)):
        x = METRES_PER_PIXEL * -row + 7.0
        y = METRES_PER_PIXEL * -(column + STEP_PIXELS * frame) - 3.0
        lines.append(f"{frame}.png,{column},{row},{x},{y + (0.5 if row == 99 else 0.0)}")
    points = tmp_path / "points.csv"
    points.write_text(HEADER + "\n".join(lines) + "\n")
    result = slam("stitch", frames, "-o", tmp_path / "map", "--control", points)
    assert result.exit_code == 0, result.output
    assert "by 4 control points" in result.output
    assert "outlier 0.png 99,99: 0.5 m off" in result.output
    assert steps(tmp_path / "map") == pytest.approx([STEP_PIXELS * METRES_PER_PIXEL] * 3, rel=2e-3)
    first = read_rows(tmp_path / "map" / "poses.csv")[0]
    assert float(first["x"]) == pytest.approx(7.0 - METRES_PER_PIXEL * 95.5, abs=1e-3)
    assert float(first["y"]) == pytest.approx(-3.0 - METRES_PER_PIXEL * 127.5, abs=1e-3)
    again = slam("render", tmp_path / "map", "-o", tmp_path / "again", "--frames", frames)
    assert again.exit_code == 0, again.output
    mosaics = [(tmp_path / name / "mosaic.png").read_bytes() for name in ("map", "again")]
    assert mosaics[0] == mosaics[1]


def test_a_scale_bar_gives_metres(frames: Path, tmp_path: Path) -> None:
    bar = "2.png,10,20,110,20,0.2"
    result = slam("stitch", frames, "-o", tmp_path / "map", "--scale", bar, "--mount", "hand")
    assert result.exit_code == 0, result.output
    assert "by the scale bar" in result.output
    assert steps(tmp_path / "map") == pytest.approx([STEP_PIXELS * METRES_PER_PIXEL] * 3, rel=5e-3)


def test_a_bar_in_no_frame_and_a_broken_one_are_refused(frames: Path, tmp_path: Path) -> None:
    for bar, message in (
        ("9.png,10,20,110,20,0.2", "which is none of the frames"),
        ("2.png,10,20,10,20,0.2", "the two pixels are one"),
        ("2.png,10,20,0.2", "is not frame,column,row,column,row,metres"),
    ):
        result = slam("stitch", frames, "-o", tmp_path / "map", "--scale", bar)
        assert result.exit_code in {1, 2}, result.output
        assert message in result.output


def test_latitudes_and_longitudes_are_metres_from_the_first(tmp_path: Path) -> None:
    points = tmp_path / "points.csv"
    points.write_text(
        "frame,column,row,latitude,longitude\na.jpg,1,2,48.0,11.0\nb.jpg,3,4,48.0001,11.0\n"
    )
    read = from_first(read_control_points(points))
    assert read.frames == ("a.jpg", "b.jpg")
    assert read.places[0] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert read.places[1] == pytest.approx([0.0, 11.1], abs=0.05)


def test_a_scaled_camera_sees_the_same_floor() -> None:
    pixels = top_down_calibration((256, 192))
    in_metres = type(pixels)(
        **{name: getattr(pixels, name) for name in pixels.__slots__}
        | {
            "robot_from_image": np.diag([0.002, 0.002, 1.0]) @ pixels.robot_from_image,
            "unit": "m",
        }
    )
    corner = np.array([[255.0, 10.0]])
    tilt = math.radians(4.0), math.radians(-3.0)
    seen = [
        apply_homography(rocked(camera, Rocking(*tilt, height)).robot_from_image, corner)
        for camera, height in ((pixels, 30.0), (in_metres, 0.06))
    ]
    assert seen[1] == pytest.approx(0.002 * seen[0], rel=1e-12)
