"""Numbers that no floor has, in files: one line that names the file and what is needed."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import make_photographer

from slamcli.core.bounds import quoted
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import check_metres_per_pixel, footprint_hull
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.errors import CalibrationError, InputError
from slamcli.core.geometry import Pose2
from slamcli.core.telemetry import (
    COMPASS_SIGMA_RADIANS,
    CompassReading,
    GpsReading,
    OdometryReading,
)
from slamcli.io.calibrations import calibration_text, load_calibration
from slamcli.io.files import read_text
from slamcli.io.telemetry import read_compass, read_gps, read_odometry
from slamcli.io.trajectories import read_trajectory

HOSTILE = ("nan", "inf", "-inf", "1e300", "1e18", "9" * 400, "text", "0x1")


def calibration() -> Calibration:
    return make_photographer().calibration


@pytest.mark.parametrize("value", HOSTILE)
@pytest.mark.parametrize("column", ["stamp", "latitude", "longitude", "sigma"])
def test_a_field_of_gps_is_within_bounds(tmp_path: Path, column: str, value: str) -> None:
    row = {"stamp": "1", "latitude": "2", "longitude": "3", "sigma": "4", column: value}
    file = tmp_path / "gps.csv"
    file.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    with pytest.raises(InputError, match=rf"gps.csv, line 2: {column} is .* is needed$") as raised:
        read_gps(file)
    assert len(str(raised.value)) < 300


@pytest.mark.parametrize("value", HOSTILE)
def test_a_sigma_that_no_solver_could_use_is_refused(tmp_path: Path, value: str) -> None:
    file = tmp_path / "compass.csv"
    file.write_text(f"stamp,heading,sigma\n0,0,{value}\n")
    with pytest.raises(InputError, match=r"line 2: sigma is .* a number from 0 to 1000 "):
        read_compass(file)


@pytest.mark.parametrize("value", ["0", "1e-18"])
def test_a_sigma_too_small_for_a_solver_is_not_known(tmp_path: Path, value: str) -> None:
    file = tmp_path / "compass.csv"
    file.write_text(f"stamp,heading,sigma\n0,0,{value}\n")
    (reading,) = read_compass(file)
    assert reading.with_sigma().sigma_radians == COMPASS_SIGMA_RADIANS


@pytest.mark.parametrize("value", HOSTILE[1:])
@pytest.mark.parametrize("column", ["stamp", "x", "y", "heading"])
def test_a_field_of_odometry_is_within_bounds(tmp_path: Path, column: str, value: str) -> None:
    row = {"stamp": "1", "x": "2", "y": "3", "heading": "4", column: value}
    file = tmp_path / "odometry.csv"
    file.write_text(f"{','.join(row)}\n{','.join(row.values())}\n")
    with pytest.raises(InputError, match=r"line 2: "):
        read_odometry(file)


@pytest.mark.parametrize("line", ["1 2 3 0 0 0 0 1e300", "1 1e9 3 0 0 0 0 1", "1e13 1 3 0 0 0 0 1"])
def test_numbers_of_tum_are_within_bounds(tmp_path: Path, line: str) -> None:
    file = tmp_path / "poses.txt"
    file.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match="line 2: a number is not finite, or beyond any floor"):
        read_trajectory(file)


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e300, 10**400, "1", None, True])
def test_a_reading_is_checked_when_it_is_made(value: float) -> None:
    for make in (
        lambda: OdometryReading(value, Pose2()),
        lambda: CompassReading(0.0, value, 0.1),
        lambda: CompassReading(0.0, 0.0, value),
        lambda: GpsReading(0.0, value, 0.0, 1.0),
        lambda: GpsReading(0.0, 0.0, 0.0, value),
    ):
        if value is True or value != 1:
            with pytest.raises(InputError, match="reading has"):
                make()
    with pytest.raises(InputError, match="odometry reading has x"):
        OdometryReading(0.0, Pose2(math.inf, 0.0, 0.0))


@pytest.mark.parametrize(
    "yaml",
    [
        "image_width: " + "9" * 400,
        "image_width: " + "9" * 5000,
        "image_width: 32768\nimage_height: 32768",
        "image_width: !!bool x",
        "image_width: !!int ''",
        "image_width: !!timestamp x",
        "image_width: [" * 3000,
        "distortion_coefficients: [.inf]",
        "distortion_coefficients: {data: [[1], 2]}",
    ],
)
def test_yaml_with_a_hostile_value_is_one_line(tmp_path: Path, yaml: str) -> None:
    file = tmp_path / "calibration.yaml"
    keys = {line.split(":")[0] for line in yaml.splitlines()}
    good = calibration_text(calibration()).splitlines()
    file.write_text("\n".join([yaml, *(k for k in good if k.split(":")[0] not in keys)]))
    with pytest.raises(CalibrationError) as raised:
        load_calibration(file)
    assert len(str(raised.value)) < 300
    assert "\n" not in str(raised.value)


def test_yaml_whose_aliases_stand_for_billions_of_numbers_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "calibration.yaml"
    lines = ["a0: &a0 [1,1,1,1,1,1,1,1,1,1]"]
    lines += [f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    good = calibration_text(calibration()).replace("data: [", "unused: [", 1)
    lines += [good.replace("camera_matrix:", "camera_matrix:\n  data: *a11", 1)]
    file.write_text("\n".join(lines))
    with pytest.raises(CalibrationError, match=r"camera_matrix .*numbers are needed"):
        load_calibration(file)


def test_what_is_no_regular_file_is_not_read(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo.csv"
    os.mkfifo(fifo)
    for path in (fifo, Path("/dev/zero")):
        with pytest.raises(InputError, match="it is not a regular file"):
            read_text(path, "poses")
    with pytest.raises(InputError, match="cannot read the poses"):
        read_text(Path("a\0b"), "poses")


@pytest.mark.parametrize("scale", [1e-6, 0.5, 1e3])
def test_a_resolution_out_of_proportion_is_refused_with_those_that_serve(scale: float) -> None:
    with pytest.raises(InputError, match=r"give --metres-per-pixel from .* to ") as raised:
        check_metres_per_pixel(calibration(), scale, 2**24)
    finest, coarsest = (float(word) for word in str(raised.value).split()[-3::2])
    for good in (1.01 * finest, 0.99 * coarsest):
        check_metres_per_pixel(calibration(), good, 2**24)


def test_a_camera_whose_floor_has_no_area_is_named() -> None:
    flat = calibration()
    squeezed = np.diag([1.0, 0.0, 1.0]) @ flat.robot_from_image
    with pytest.raises(CalibrationError, match="no area"):
        footprint_hull(replace(flat, robot_from_image=squeezed + 1e-300))


def test_the_resolution_of_a_picture_is_the_same_in_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    bent = replace(calibration(), distortion=np.array([-0.2, 0.03, 1e-3, -1e-3, 0.0]))
    for camera in (calibration(), bent):
        whole = resolution_image(camera)
        monkeypatch.setattr("slamcli.core.camera.resolution._BAND_PIXELS", 7000)
        resolution_image.cache_clear()
        assert np.array_equal(whole, resolution_image(camera))
        monkeypatch.undo()
        resolution_image.cache_clear()


def test_values_in_messages_are_short() -> None:
    assert quoted(10**400).endswith("...")
    assert quoted(10**5000) == "a number of thousands of digits"
    assert quoted("1") == "'1'"
