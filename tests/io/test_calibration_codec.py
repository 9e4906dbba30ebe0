"""A calibration as plain values: it comes back to the last bit, and nothing unsound does."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from floor_pictures import forward_camera, top_down

from slamcli.core.camera.calibration import Calibration
from slamcli.io.calibration_codec import from_dict, intrinsics_from_dict, to_dict
from slamcli.io.checks import FieldError
from slamcli.io.runs import camera_section
from slamcli.io.toml import write_toml


def assert_same(one: Calibration, other: Calibration) -> None:
    for field in fields(Calibration):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if isinstance(a, np.ndarray | float):
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        else:
            assert a == b, field.name


@pytest.mark.parametrize("calibration", [forward_camera(), top_down()])
def test_a_calibration_comes_back_through_json(calibration: Calibration) -> None:
    text = json.dumps(to_dict(calibration), allow_nan=False)
    assert_same(from_dict(json.loads(text)), calibration)


@pytest.mark.parametrize("calibration", [forward_camera(), top_down()])
def test_a_calibration_comes_back_from_run_toml(calibration: Calibration, tmp_path: Path) -> None:
    write_toml(tmp_path / "run.toml", {"camera": camera_section(calibration)})
    section = tomllib.loads((tmp_path / "run.toml").read_text())["camera"]
    assert list(section)[:6] == [
        "camera_matrix",
        "distortion",
        "distortion_model",
        "image_size",
        "robot_from_image",
        "unit",
    ]
    assert_same(from_dict(section), calibration)


def test_the_homography_is_composed_where_it_is_left_out() -> None:
    section = to_dict(forward_camera())
    del section["robot_from_image"]
    assert_same(from_dict(section), forward_camera())
    for name in ("height_metres", "pitch_radians", "roll_radians"):
        with pytest.raises(FieldError, match=f"^{name} is not known"):
            from_dict({**section, name: None})


def test_what_is_optional_has_its_default() -> None:
    section = to_dict(forward_camera())
    for name in [name for name in section if "sigma" in name or name in {"unit", "distortion"}]:
        del section[name]
    read = from_dict(section)
    assert (read.unit, len(read.distortion)) == ("m", 5)
    assert math.isnan(read.focal_sigma_pixels)
    assert intrinsics_from_dict(section).image_size == (640, 480)


TILTED = {"robot_from_image": (forward_camera().robot_from_image + 0.01).tolist()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_matrix": None}, "camera_matrix is None"),
        ({"camera_matrix": "fx"}, "camera_matrix is 'fx'"),
        ({"camera_matrix": [[1.0, 2.0], [3.0]]}, "camera_matrix is"),
        ({"camera_matrix": []}, "none at all"),
        ({"camera_matrix": [1.0] * 8}, "camera_matrix has 8 numbers; 3 x 3"),
        ({"camera_matrix": [math.nan] * 9}, "camera_matrix has a number that is not finite"),
        ({"camera_matrix": [10**400] * 9}, "camera_matrix is"),
        ({"camera_matrix": [1e8] * 9}, "1e[+]07 or more"),
        ({"camera_matrix": [0.0] * 9}, "camera_matrix is singular"),
        ({"camera_matrix": [1.0, 0, 0, 0.5, 1.0, 0, 0, 0, 1.0]}, "not of the form"),
        ({"distortion": [0.0] * 6}, "distortion has 6 numbers; plumb_bob has 4 or 5"),
        ({"distortion": [math.inf] * 5}, "distortion has a number that is not finite"),
        ({"distortion_model": "magic"}, "distortion_model is 'magic'"),
        ({"distortion_model": "equidistant"}, "equidistant has 4"),
        ({"image_size": 640}, "image_size is 640"),
        ({"image_size": [640]}, "width and height"),
        ({"image_size": [640, 0]}, "image_size height is 0"),
        ({"image_size": [10**6, 480]}, "image_size width is 1000000"),
        ({"image_size": [640.5, 480]}, "whole pixels"),
        ({"image_size": [True, 480]}, "image_size width is True"),
        ({"robot_from_image": [[0.0] * 3] * 3}, "cannot be inverted"),
        (TILTED, "robot_from_image does not agree"),
        ({"height_metres": 0.35}, "robot_from_image does not agree"),
        ({"height_metres": 0.0}, "height_metres is 0"),
        ({"height_metres": "high"}, "height_metres is 'high'"),
        ({"height_metres": math.inf}, "height_metres is inf"),
        ({"pitch_radians": 4.0}, "pitch_radians is 4"),
        ({"roll_radians": -4}, "roll_radians is -4"),
        ({"max_range_metres": 0}, "max_range_metres is 0"),
        ({"max_range_metres": None}, "max_range_metres is None"),
        ({"height_sigma_metres": -0.1}, "height_sigma_metres is -0.1"),
        ({"unit": "feet"}, "unit is 'feet'"),
        ({"unit": "px"}, "height_metres is given, but the unit px"),
    ],
)
def test_what_no_camera_has_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(FieldError, match=message):
        from_dict({**to_dict(forward_camera()), **changes})


@pytest.mark.parametrize(
    "name",
    ["camera_matrix", "image_size", "max_range_metres", "height_metres", "pitch_radians"],
)
def test_what_is_missing_is_named(name: str) -> None:
    section = to_dict(forward_camera())
    del section[name]
    with pytest.raises(FieldError, match=f"^{name} is missing"):
        from_dict(section)
