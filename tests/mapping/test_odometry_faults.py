"""Wrong odometry beside good frames: named and not used, in the library and on the command line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import slamcli
from slamcli.cli.main import main
from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.telemetry import OdometryReading
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import write_image
from slamcli.io.telemetry import write_odometry
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions
from slamcli.stages.telemetry import interpolate

RATE_HERTZ, FRAMES, BLANK = 10.0, 24, range(10, 14)


@pytest.fixture(scope="module")
def world() -> tuple[slamcli.Calibration, list[Pose2], list[np.ndarray]]:
    """The camera, the true poses, and the pictures; four of them of bare floor."""
    floor = floors.make_floor("asphalt", FloorOptions(wear=0.0), 0.001, seed=3)
    options = CameraOptions(size=(320, 240), height_metres=0.2, pitch_degrees=45.0)
    photographer = photograph.Photographer(photograph.World(floor), photograph.make_camera(options))
    truth = [Pose2()]
    for index in range(FRAMES - 1):
        length = 0.03 + 0.015 * math.sin(0.8 * index)
        truth.append(truth[-1] @ Pose2(length, 0.0, 0.03 + 0.1 * math.sin(0.5 * index)))
    pictures = []
    for index, pose in enumerate(truth):
        generator = np.random.default_rng(index)
        picture = np.clip(120.0 + 2.0 * generator.standard_normal((240, 320, 3)), 0, 255)
        if index not in BLANK:
            still, none = (pose, pose), DisturbanceOptions()
            picture = photograph.take(photographer, still, 0.0, none, generator)
        pictures.append(picture.astype(np.uint8))
    return photographer.calibration, truth, pictures


def readings(truth: list[Pose2], fault: str) -> list[OdometryReading]:
    """At 50 Hz, 1 % too long."""
    found = []
    for index in range(FRAMES - 1):
        for part in range(5):
            true = interpolate(truth[index], truth[index + 1], part / 5)
            found.append(
                ((index + part / 5) / RATE_HERTZ, 1.01 * true.x, 1.01 * true.y, true.theta)
            )
    rows = np.array(found)
    if fault == "degrees":
        rows[:, 3] = np.degrees(rows[:, 3])
    elif fault == "left-handed":
        rows[:, 2:] *= -1.0
    elif fault == "millimetres":
        rows[:, 1:3] *= 1000.0
    elif fault == "clock":
        rows[:, 0] += 0.4
    elif fault == "reset":
        anew = Pose2(*rows[58, 1:]).inverse()
        rows[58:, 1:] = pose_array([anew @ Pose2(*row) for row in rows[58:, 1:]])
    return [OdometryReading(stamp, Pose2(*row)) for stamp, *row in rows.tolist()]


def error_metres(estimates: list[slamcli.PoseEstimate], truth: list[Pose2]) -> float:
    """Absolute trajectory error after the best rigid alignment."""
    placed = [e for e in estimates if e.map_from_robot is not None]
    assert {e.fragment for e in placed} == {0}
    found = pose_array([e.map_from_robot for e in placed if e.map_from_robot])[:, :2] @ (1.0, 1j)
    known = pose_array([truth[e.index] for e in placed])[:, :2] @ (1.0, 1j)
    found, known = found - found.mean(), known - known.mean()
    turn = np.angle(np.vdot(found, known))
    return float(np.sqrt(np.mean(np.abs(np.exp(1j * turn) * found - known) ** 2)))


@pytest.mark.parametrize(
    ("fault", "named", "least"),
    [
        pytest.param("none", "", 24, marks=pytest.mark.slow),
        ("reset", "odometry is reset at 1.160 s", 22),
        pytest.param("degrees", "headings are in degrees", 16, marks=pytest.mark.slow),
        pytest.param("left-handed", "y axis and headings", 16, marks=pytest.mark.slow),
        pytest.param("millimetres", "in millimetres", 14, marks=pytest.mark.slow),
        pytest.param("clock", "give --time-offset -0.40", 16, marks=pytest.mark.slow),
    ],
)
def test_wrong_odometry_is_named_and_the_frames_stay_right(
    world: tuple[slamcli.Calibration, list[Pose2], list[np.ndarray]],
    fault: str,
    named: str,
    least: int,
) -> None:
    calibration, truth, pictures = world
    mapper = slamcli.Mapper(calibration)
    for reading in readings(truth, fault):
        mapper.odometry(reading)
    for index, picture in enumerate(pictures):
        mapper.update(slamcli.Frame(index, str(index), index / RATE_HERTZ, picture))
    estimates = mapper.finish()
    assert [named in line for line in mapper.sensor_faults] == [True] * bool(named)
    assert error_metres(estimates, truth) <= 0.002
    assert sum(e.map_from_robot is not None for e in estimates) >= least


@pytest.fixture
def folder(
    tmp_path: Path, world: tuple[slamcli.Calibration, list[Pose2], list[np.ndarray]]
) -> Path:
    calibration, _, pictures = world
    for index, picture in enumerate(pictures):
        write_image(tmp_path / "frames" / f"{index:04d}.png", picture)
    save_calibration(tmp_path / "camera.yaml", calibration)
    return tmp_path


def stitch(folder: Path, truth: list[Pose2], fault: str, *more: str) -> tuple[int, str]:
    found = readings(truth, fault)
    write_odometry(folder / "odometry.csv", [r.stamp for r in found], [r.pose for r in found])
    command = ["stitch", str(folder / "frames"), "-c", str(folder / "camera.yaml"), "-q"]
    command += ["-o", str(folder / "out"), "--frame-rate", "10", *more]
    result = CliRunner().invoke(main, [*command, "--odometry", str(folder / "odometry.csv")])
    return result.exit_code, result.output


def test_stitch_refuses_odometry_that_contradicts_the_frames(
    folder: Path, world: tuple[slamcli.Calibration, list[Pose2], list[np.ndarray]]
) -> None:
    code, printed = stitch(folder, world[1], "left-handed")
    assert code == 1
    expected = "odometry.csv contradicts the frames: its y axis and headings are left-handed"
    assert expected in printed
    assert not (folder / "out").exists()


def test_stitch_refuses_readings_of_another_time_at_once(
    folder: Path, world: tuple[slamcli.Calibration, list[Pose2], list[np.ndarray]]
) -> None:
    code, printed = stitch(folder, world[1], "none", "--time-offset", "5")
    assert code == 1
    assert "covers 5.000 to 7.280 s and the frames 0.000 to 2.300 s: their clocks differ" in printed
    assert "give --time-offset 0.000" in printed
    assert not (folder / "out").exists()
