"""Calibration files: what is written is read back, what is wrong with one is said in one line."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import seen_floor
from slamcli.core.camera.mounting import compose_robot_from_image
from slamcli.core.errors import CalibrationError
from slamcli.io.calibrations import (
    CalibrationSource,
    load_calibration,
    load_intrinsics,
    save_calibration,
)

SAMPLES = Path(__file__).resolve().parent.parent.parent / "calibration"


def example(**changes: object) -> Calibration:
    matrix = np.array([[612.3456789, 0.0, 319.5], [0.0, 611.1, 240.25], [0.0, 0.0, 1.0]])
    height, pitch, roll = 0.2718281828, math.radians(31.4159), math.radians(-1.7)
    calibration = Calibration(
        camera_matrix=matrix,
        distortion=np.array([-0.21, 1e-05, -2e-17, 0.0, 0.3]),
        distortion_model="plumb_bob",
        image_size=(640, 480),
        robot_from_image=compose_robot_from_image(matrix, height, pitch, roll),
        height_metres=height,
        pitch_radians=pitch,
        roll_radians=roll,
        max_range_metres=1.25,
        height_sigma_metres=0.001,
        pitch_sigma_radians=0.002,
        covariance=np.diag([4e-6, 9e-6, 4e-6, 1e-6]) + 1e-6,
    )
    return replace(calibration, **changes)  # type: ignore[arg-type]


def saved(folder: Path, **changes: object) -> Path:
    path = folder / "calibration.yaml"
    save_calibration(path, example(**changes))
    return path


def edited(folder: Path, edit: object) -> Path:
    """Save the example, pass its document to `edit`, and write what remains."""
    path = saved(folder)
    document = yaml.safe_load(path.read_text())
    edit(document)  # type: ignore[operator]
    path.write_text(yaml.safe_dump(document))
    return path


@pytest.mark.parametrize(
    ("model", "distortion"),
    [
        ("plumb_bob", [-0.21, 1e-05, -2e-17, 0.0, 0.3]),
        ("rational_polynomial", [0.1, 0.2, 0.0, 0.0, 0.1, 0.3, 0.1, 1e20]),
        ("equidistant", [0.01, -0.02, 0.0, 1e-300]),
    ],
)
def test_it_comes_back_to_the_last_bit(tmp_path: Path, model: str, distortion: list[float]) -> None:
    written = example(distortion_model=model, distortion=np.array(distortion))
    path = tmp_path / "calibration.yaml"
    save_calibration(
        path, written, CalibrationSource('a "b" ä: #.png', "square", 0.3, np.eye(4)[:, :2])
    )
    read = load_calibration(path)
    for name in ("camera_matrix", "distortion", "robot_from_image"):
        assert np.allclose(getattr(read, name), getattr(written, name), rtol=1e-14, atol=0)
    for name in ("height_metres", "pitch_radians", "roll_radians", "max_range_metres"):
        assert getattr(read, name) == pytest.approx(getattr(written, name), rel=1e-15)
    assert (read.image_size, read.distortion_model) == (written.image_size, model)
    assert read.pitch_sigma_radians == pytest.approx(0.002, rel=1e-15)
    assert math.isnan(read.focal_sigma_pixels)
    assert np.array_equal(read.covariance, written.covariance)
    assert (
        yaml.safe_load(path.read_text())["ground_plane"]["made_from"]["photo"] == 'a "b" ä: #.png'
    )


def test_writing_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    first = saved(tmp_path).read_bytes()
    read = load_calibration(tmp_path / "calibration.yaml")
    save_calibration(tmp_path / "again.yaml", read)
    assert (tmp_path / "again.yaml").read_bytes() == first


def test_it_is_a_camera_info_file(tmp_path: Path) -> None:
    path = saved(tmp_path)
    intrinsics = load_intrinsics(path)
    assert np.array_equal(intrinsics.camera_matrix, example().camera_matrix)
    document = yaml.safe_load(path.read_text())
    assert np.shape(document["projection_matrix"]["data"]) == (12,)
    assert np.shape(document["rectification_matrix"]["data"]) == (9,)
    assert document["camera_name"]


def test_the_homography_may_be_left_out(tmp_path: Path) -> None:
    path = edited(tmp_path, lambda document: document["ground_plane"].pop("robot_from_image"))
    assert np.allclose(load_calibration(path).robot_from_image, example().robot_from_image)


def test_a_homography_of_another_scale_or_rounded_by_hand_agrees(tmp_path: Path) -> None:
    def scale(document: dict) -> None:  # type: ignore[type-arg]
        matrix = document["ground_plane"]["robot_from_image"]
        matrix["data"] = [float(f"{-3.0 * value:.6g}") for value in matrix["data"]]

    assert np.allclose(
        load_calibration(edited(tmp_path, scale)).robot_from_image, example().robot_from_image
    )


def put(*keys: str, value: object) -> object:
    def edit(document: dict) -> None:  # type: ignore[type-arg]
        for key in keys[:-1]:
            document = document[key]
        document[keys[-1]] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("camera_matrix"), "camera_matrix is missing"),
        (lambda d: d.pop("image_width"), "image_width is missing"),
        (lambda d: d.pop("ground_plane"), "no ground_plane"),
        (lambda d: d["ground_plane"].pop("pitch_degrees"), "pitch_degrees is missing"),
        (put("image_width", value=0), "image_width"),
        (put("image_height", value="tall"), "image_height"),
        (put("camera_matrix", "data", value=[1.0] * 8), "camera_matrix has 8 numbers"),
        (put("camera_matrix", "data", value=[0.0] * 9), "singular"),
        (put("camera_matrix", "data", value=[math.nan] * 9), "not finite"),
        (put("camera_matrix", value={"rows": 3}), "no data"),
        (put("distortion_model", value="wobbly"), "distortion_model is 'wobbly'"),
        (put("distortion_coefficients", "data", value=[0.0] * 3), "has 3 numbers"),
        (put("ground_plane", "height_metres", value=0.0), "height_metres is 0"),
        (put("ground_plane", "height_metres", value=-0.2), "height_metres is -0.2"),
        (put("ground_plane", "height_metres", value=math.inf), "height_metres is inf"),
        (put("ground_plane", "height_metres", value=10**400), "height_metres is too large"),
        (put("ground_plane", "pitch_degrees", value=200.0), "pitch_degrees, in radians, is 3.49"),
        (put("ground_plane", "roll_sigma_degrees", value=-1.0), "roll_sigma_degrees"),
        (put("ground_plane", "max_range_metres", value=0), "max_range_metres is 0"),
        (put("ground_plane", "pitch_degrees", value=None), "pitch_degrees"),
        (put("ground_plane", "pitch_sigma_degrees", value="small"), "pitch_sigma_degrees"),
        (put("ground_plane", "format_version", value=2), "format_version is 2"),
        (put("ground_plane", "robot_from_image", "data", value=[1.0] * 9), "singular"),
        (put("ground_plane", "height_metres", value=0.28), "does not agree"),
        (put("ground_plane", "roll_degrees", value=1.7), "does not agree"),
        (put("ground_plane", "covariance", "data", value=[-1.0] * 16), "is no covariance"),
        (put("ground_plane", "covariance", "data", value=[*range(16)]), "is no covariance"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, edit: object, message: str) -> None:
    with pytest.raises(CalibrationError, match=message) as caught:
        load_calibration(edited(tmp_path, edit))
    assert "\n" not in str(caught.value)
    assert "calibration.yaml" in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "just words", "a: [1, 2", "- 1\n- 2\n", "\x00", "!!python/object:os.system {}"]
)
def test_a_file_that_is_no_calibration_is_said_to_be_none(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=r"broken\.yaml: not a calibration file") as caught:
        load_calibration(path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.yaml"):
        load_calibration(tmp_path / "none.yaml")


@pytest.mark.parametrize("name", ["simulated_square.yaml", "webcam_low.yaml"])
def test_the_samples_load(name: str) -> None:
    calibration = load_calibration(str(SAMPLES / name))
    assert seen_floor(calibration).shape[1] == 2


@pytest.mark.parametrize("height", [9e-7, 2e7])
def test_numbers_that_could_not_be_read_again_are_not_written(
    tmp_path: Path, height: float
) -> None:
    path = tmp_path / "calibration.yaml"
    with pytest.raises(CalibrationError, match=r"ground_plane.height_metres is .* a number from"):
        save_calibration(path, example(height_metres=height))
    assert not path.exists()


def test_the_direction_ahead_comes_back(tmp_path: Path) -> None:
    assert (
        "ahead" not in saved(tmp_path).read_text().split("ground_plane")[1].partition("x ahead")[2]
    )
    ahead = math.radians(-90.0)
    written = example(ahead_radians=ahead, pitch_radians=math.radians(91.0))
    composed = compose_robot_from_image(
        written.camera_matrix,
        written.height_metres,
        written.pitch_radians,
        written.roll_radians,
        ahead,
    )
    path = saved(
        tmp_path,
        ahead_radians=ahead,
        pitch_radians=written.pitch_radians,
        robot_from_image=composed,
    )
    read = load_calibration(path)
    assert read.ahead_radians == pytest.approx(ahead, rel=1e-15)
    assert np.allclose(read.robot_from_image, composed, rtol=1e-12)
