"""camera_info in the forms that ROS, OpenCV and their tools write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamcli.core.errors import CalibrationError
from slamcli.io.calibrations import load_intrinsics

ROS_FILE = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [600.0, 0.0, 319.5, 0.0, 601.0, 239.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.2, 3e-1, 0.001, -1E-3, 0]
"""

ROS_2_ECHO = """header:
  stamp:
    sec: 12
    nanosec: 5000
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.2
- 0.3
- 0.001
- -0.001
- 0.0
k:
- 600.0
- 0.0
- 319.5
- 0.0
- 601.0
- 239.5
- 0.0
- 0.0
- 1.0
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [600.0, 0.0, 319.5, 0.0, 0.0, 601.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""

ROS_1_ECHO = """header:
  seq: 1
height: 480
width: 640
distortion_model: "plumb_bob"
D: [-0.2, 0.3, 0.001, -0.001, 0.0]
K: [600.0, 0.0, 319.5, 0.0, 601.0, 239.5, 0.0, 0.0, 1.0]
binning_x: 1
---
height: 480
"""

OPENCV_FILE = """%YAML:1.0
---
calibration_time: "Sat Nov 28 2026"
image_Width: 640
image_Height: 480
Camera_Matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.00e+02, 0., 3.195e+02, 0., 6.01e+02, 2.395e+02, 0., 0., 1. ]
Distortion_Coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.0e-01, 3.0e-01, 1.0e-03, -1.0e-03, 0. ]
"""

RATIONAL = [0.1, -0.05, 0.0, 0.0, 0.01, 0.3, -0.02, 0.01]


def load(folder: Path, text: str):  # type: ignore[no-untyped-def]
    path = folder / "camera_info.yaml"
    path.write_text(text)
    return load_intrinsics(path)


@pytest.mark.parametrize("text", [ROS_FILE, ROS_2_ECHO, ROS_1_ECHO, OPENCV_FILE])
def test_every_form_gives_the_same_camera(tmp_path: Path, text: str) -> None:
    camera = load(tmp_path, text)
    assert camera.image_size == (640, 480)
    assert camera.camera_matrix.tolist() == [[600, 0, 319.5], [0, 601, 239.5], [0, 0, 1]]
    assert camera.distortion.tolist() == [-0.2, 0.3, 0.001, -0.001, 0.0]
    assert camera.distortion_model == "plumb_bob"


def with_model(keys: str, coefficients: list[float]) -> str:
    return f"{keys}\nd: {coefficients}\n" + "\n".join(
        line for line in ROS_1_ECHO.splitlines()[2:7] if not line.startswith(("D:", "distortion"))
    )


@pytest.mark.parametrize(
    ("keys", "coefficients", "model", "kept"),
    [
        ("camera_model: plumb_bob", [-0.2, 0.1, 0, 0], "plumb_bob", [-0.2, 0.1, 0, 0]),
        ("distortion_model: Plumb Bob", [], "plumb_bob", [0.0] * 5),
        ("distortion_model: ''", [], "plumb_bob", [0.0] * 5),
        ("camera_model: pinhole\ndistortion_model: radtan", [0.1] * 4, "plumb_bob", [0.1] * 4),
        ("camera_model: pinhole\ndistortion_model: equidistant", [0.1] * 4, "equidistant", None),
        ("camera_model: fisheye", [0.1] * 4, "equidistant", [0.1] * 4),
        ("fisheye_model: 1", [0.1] * 4, "equidistant", [0.1] * 4),
        ("distortion_model: fisheye", [0.1] * 4 + [0.0], "equidistant", [0.1] * 4),
        ("distortion_model: rational_polynomial", RATIONAL, "rational_polynomial", RATIONAL),
        ("camera_model: rational", [*RATIONAL, 0, 0, 0, 0], "rational_polynomial", RATIONAL),
        ("camera_name: without_a_model", RATIONAL, "rational_polynomial", RATIONAL),
    ],
)
def test_every_model_is_read_by_all_its_names(
    tmp_path: Path, keys: str, coefficients: list[float], model: str, kept: list[float] | None
) -> None:
    camera = load(tmp_path, with_model(keys, coefficients))
    assert camera.distortion_model == model
    assert np.array_equal(camera.distortion, coefficients if kept is None else kept)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (with_model("camera_model: fisheye\ndistortion_model: plumb_bob", [0.1] * 4), "contradict"),
        (with_model("distortion_model: omnidirectional", []), "distortion_model is 'omnidir"),
        (with_model("distortion_model: equidistant", [0.1] * 5), "has 5 numbers"),
        (with_model("camera_model: rational", [*RATIONAL, 0.1, 0, 0, 0]), "has 12 numbers"),
        (ROS_FILE + "width: 320\n", "image_width and width contradict"),
        (ROS_FILE + "K: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", "camera_matrix and k contradict"),
        (ROS_FILE + "Image_Width: 320\n", "image_width is given twice"),
        (ROS_2_ECHO.replace("x_offset: 0", "x_offset: 8"), "roi is a part of the picture"),
        (ROS_2_ECHO.replace("binning_x: 0", "binning_x: 2"), "binning_x is not 1"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        load(tmp_path, text)
    assert "camera_info.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)
