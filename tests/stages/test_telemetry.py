"""Odometry, compass and GPS: read from files, interpolated, their clock found."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from slamcli.core.errors import InputError
from slamcli.core.geometry import Pose2, compose_poses, pose_array, relative_poses
from slamcli.core.telemetry import CompassReading, GpsReading, OdometryReading, TelemetryOptions
from slamcli.io import telemetry as files
from slamcli.io.trajectories import write_tum
from slamcli.stages import telemetry


def track(stamps: list[float], poses: list[Pose2], **options: float) -> telemetry.OdometryTrack:
    made = telemetry.OdometryTrack(TelemetryOptions(**options))
    for stamp, pose in zip(stamps, poses, strict=True):
        made.add(OdometryReading(stamp, pose))
    return made


def test_half_way_lies_on_the_arc() -> None:
    # A quarter circle of radius 2 m to the left, begun at (1, 1) with the robot looking along y.
    start = Pose2(1.0, 1.0, math.pi / 2)
    end = start @ Pose2(2.0, 2.0, math.pi / 2)
    middle = telemetry.interpolate(start, end, 0.5)
    expected = start @ Pose2(2 * math.sin(math.pi / 4), 2 - 2 * math.cos(math.pi / 4), math.pi / 4)
    assert (middle.x, middle.y) == pytest.approx((expected.x, expected.y))
    assert middle.theta == pytest.approx(expected.theta)
    straight = telemetry.interpolate(Pose2(0, 0, 0.3), Pose2(0, 0, 0.3) @ Pose2(4.0), 0.25)
    assert (straight.x, straight.y) == pytest.approx((math.cos(0.3), math.sin(0.3)))
    # Across the seam of the angles.
    seam = telemetry.interpolate(Pose2(0, 0, 3.1), Pose2(0, 0, -3.1), 0.5)
    assert abs(seam.theta) == pytest.approx(math.pi)


def test_odometry_covers_the_moments_between_its_readings_and_no_others() -> None:
    moves = track([0.0, 0.1, 0.2, 1.2, 1.3], [Pose2(float(i)) for i in range(5)])
    assert moves.motion(0.05, 0.15) == Pose2(1.0)
    known = moves.at(0.1 + 1e-6)
    assert known == Pose2(1.0)
    for stamp in (-0.01, 0.5, 1.45):
        assert moves.at(stamp) is None, stamp
        assert moves.motion(0.0, stamp) is None
    # On a robot a frame comes before the next reading.
    assert moves.at(1.35) == Pose2(4.5)
    assert moves.motion(None, 0.1) is None
    shifted = track([0.0, 0.1], [Pose2(), Pose2(1.0)], time_offset_seconds=5.0)
    assert shifted.at(5.05) == Pose2(0.5)
    assert shifted.at(0.05) is None
    late = track([0.2, 0.0, 0.1, 0.1], [Pose2(2.0), Pose2(), Pose2(1.0), Pose2(9.0)])
    assert late.at(0.15) == Pose2(1.5)


def test_the_sigma_of_odometry_does_not_depend_on_how_often_one_looks() -> None:
    options = TelemetryOptions(odometry_metres=0.0, odometry_radians=0.0)
    whole = telemetry.motion_covariance(Pose2(10.0), options)
    parts = 50 * telemetry.motion_covariance(Pose2(0.2), options)
    np.testing.assert_allclose(whole, parts)
    assert math.sqrt(whole[0, 0]) == pytest.approx(0.02 * 10.0)
    assert math.sqrt(whole[2, 2]) == pytest.approx(0.005 * 10.0)
    turned = telemetry.motion_covariance(Pose2(0.0, 0.0, -math.pi / 2), options)
    assert math.sqrt(turned[2, 2]) == pytest.approx(0.02 * math.pi)


def drive(offset: float, seed: int, *, steady: bool = False) -> tuple[np.ndarray, ...]:
    """Odometry at 47 Hz with 3 % gain, drift and noise; visual poses at 10 Hz in a later clock."""
    generator = np.random.default_rng(seed)
    fine = np.arange(0.0, 30.0, 0.001)
    speed, turn = np.full(len(fine), 0.4), np.full(len(fine), 0.2)
    if not steady:
        speed = 0.4 + 0.2 * np.sin(0.9 * fine) + 0.1 * np.sin(2.3 * fine + 1)
        turn = 0.8 * np.sin(0.7 * fine) * np.sin(0.31 * fine)
    heading = np.cumsum(turn) * 0.001
    x, y = (np.cumsum(speed * part(heading)) * 0.001 for part in (np.cos, np.sin))
    true = np.column_stack([x, y, heading])
    ticks, frames = np.arange(0, len(fine), 21), np.arange(500, len(fine) - 500, 100)
    felt = [true[0]]
    for step in relative_poses(true[ticks[:-1]], true[ticks[1:]]):
        noise = generator.normal(0, (3e-4, 0, 3e-4))
        felt.append(compose_poses(felt[-1], step * (1.03, 1.03, 0.98) + noise + (0, 0, 2e-4)))
    seen = true[frames] + generator.normal(0, (3e-4, 3e-4, 3e-4), (len(frames), 3))
    seen = compose_poses((3.0, 1.0, 2.0), seen)
    return fine[ticks], np.array(felt), fine[frames] + offset, seen


@pytest.mark.parametrize("offset", [0.0, 0.137, -0.81])
def test_the_offset_of_two_clocks_is_found(offset: float) -> None:
    stamps, felt, moments, seen = drive(offset, 1)
    found = telemetry.estimate_time_offset((stamps, felt), (moments, seen))
    assert found is not None
    assert found.seconds == pytest.approx(offset, abs=0.005)
    assert found.correlation > 0.9
    # A wheel that slips once does not hide it.
    felt[700:] = compose_poses((2.0, 1.0, 0.7), felt[700:])
    found = telemetry.estimate_time_offset((stamps, felt), (moments, seen))
    assert found is not None
    assert found.seconds == pytest.approx(offset, abs=0.01)


def test_an_offset_that_the_motion_leaves_open_is_not_given() -> None:
    stamps, felt, moments, seen = drive(0.3, 2, steady=True)
    assert telemetry.estimate_time_offset((stamps, felt), (moments, seen)) is None
    assert telemetry.estimate_time_offset((stamps, felt), (moments[:15], seen[:15])) is None
    stamps, felt, moments, seen = drive(4.0, 2)
    assert telemetry.estimate_time_offset((stamps, felt), (moments, seen)) is None


@pytest.mark.parametrize(
    ("bend", "correlation", "given"),
    [(1000.0, 0.6, True), (400.0, 0.6, False), (1000.0, 0.4, False)],
)
def test_a_peak_must_be_narrow_and_correlated(bend: float, correlation: float, given: bool) -> None:
    # A parabola of this second derivative has a sigma of 0.032 or 0.05 s; two steps are 0.04 s.
    grid = np.arange(-20, 21) * 0.02
    found = telemetry.clock._peak(
        lambda offset: (-0.5 * bend * (offset - 0.1) ** 2, correlation), grid
    )
    assert (found is not None) == given


def test_what_is_written_is_read(tmp_path: Path) -> None:
    stamps = [0.0, 0.1, 0.2]
    poses = [Pose2(), Pose2(0.1, 0.02, 0.3), Pose2(0.2, 0.05, -3.0)]
    files.write_odometry(tmp_path / "odometry.csv", stamps, poses)
    write_tum(tmp_path / "odometry.tum", stamps, poses)
    for name in ("odometry.csv", "odometry.tum"):
        read = files.read_odometry(tmp_path / name)
        assert [reading.stamp for reading in read] == stamps
        found = pose_array([reading.pose for reading in read])
        np.testing.assert_allclose(found, pose_array(poses), atol=1e-7)
    files.write_compass(tmp_path / "compass.csv", stamps, np.array([0.1, 0.2, 0.3]), 0.05)
    assert files.read_compass(tmp_path / "compass.csv")[1] == CompassReading(0.1, 0.2, 0.05)
    places = np.array([[29.6436, -82.3549]] * 3)
    files.write_gps(tmp_path / "gps.csv", stamps, places, 2.0)
    assert files.read_gps(tmp_path / "gps.csv")[2] == GpsReading(0.2, 29.6436, -82.3549, 2.0)


def test_usual_names_and_units_of_columns_are_known(tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    path.write_text("Timestamp,Bearing_deg\n1.5,90\n2.5,0\n")
    east, north = files.read_compass(path)
    assert east.heading_radians == pytest.approx(0.0)
    assert north.heading_radians == pytest.approx(math.pi / 2)
    assert north.sigma_radians == pytest.approx(math.radians(3))
    path.write_text("time,yaw_degrees,sigma_deg\n1.5,-90,2\n")
    (read,) = files.read_compass(path)
    assert read.heading_radians == pytest.approx(-math.pi / 2)
    assert read.sigma_radians == pytest.approx(math.radians(2))
    path.write_text("t,lat,lon,accuracy\n1,-33.9,151.2,4.5\n")
    assert files.read_gps(path) == [GpsReading(1.0, -33.9, 151.2, 4.5)]
    path.write_text("t,lat,lon\n1,-33.9,151.2\n")
    assert files.read_gps(path)[0].sigma_metres == 3.0


@pytest.mark.parametrize(
    ("reader", "content", "words"),
    [
        ("odometry", "x,y,heading\n0,0,0\n", "without stamps; odometry needs a column stamp"),
        ("odometry", "stamp,x,y,heading\n1,0,0,0\n0,0,0,0\n", "reading 2: the stamp 0.000000"),
        ("odometry", "stamp,x,y,heading\n1,0,0,zero\n", "line 2: heading is 'zero'"),
        ("compass", "stamp\n1\n", "no column heading"),
        ("compass", "stamp,heading\n", "no compass readings"),
        ("compass", "stamp,heading,sigma\n0,1,1\n\n1,1,-1\n", "line 4: sigma is '-1'; a number"),
        ("compass", "stamp,heading\n1,1\n0.5,1\n", "line 3: the stamp 0.500000 comes after"),
        ("gps", "stamp,latitude,longitude\n0,91,0\n", "line 2: latitude is '91'; a number"),
        ("gps", "stamp,latitude\n0,9\n", "no column longitude"),
        ("gps", "stamp,latitude,longitude,sigma\n0,9,9,-2\n", "line 2: sigma is '-2'; a number"),
        ("gps", "stamp,latitude,longitude,sigma\n,9,9,2\n", "line 2: stamp is ''"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, reader: str, content: str, words: str) -> None:
    path = tmp_path / "readings.csv"
    path.write_text(content)
    with pytest.raises(InputError) as raised:
        getattr(files, f"read_{reader}")(path)
    assert words in str(raised.value)
    assert "readings.csv" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_reading_of_nonsense_is_refused() -> None:
    for make in (
        lambda: OdometryReading(math.nan, Pose2()),
        lambda: OdometryReading(0.0, Pose2(math.inf, 0.0, 0.0)),
        lambda: CompassReading(0.0, 0.1, -1.0),
        lambda: GpsReading(0.0, math.nan, 0.0, 1.0),
    ):
        with pytest.raises(InputError):
            make()


@pytest.mark.parametrize(
    ("headings", "refused"),
    [
        (np.degrees(0.04 * np.arange(60)), True),
        (np.degrees(0.5 * np.sin(0.2 * np.arange(60))) % 360.0, True),
        (0.04 * np.arange(60), False),
        (0.6 * np.arange(60), False),
        (0.5 * np.sin(0.2 * np.arange(60)) % math.tau, False),
    ],
)
def test_headings_that_spin_as_no_robot_does_are_degrees(
    headings: np.ndarray, refused: bool, tmp_path: Path
) -> None:
    rows = [f"{0.1 * k:.1f},{0.02 * k:.3f},0,{heading:.6f}" for k, heading in enumerate(headings)]
    path = tmp_path / "odometry.csv"
    path.write_text("\n".join(["stamp,x,y,heading", *rows]) + "\n")
    if refused:
        with pytest.raises(InputError, match="are in degrees, not radians; name the column"):
            files.read_odometry(path)
        path.write_text(path.read_text().replace("heading", "heading_degrees"))
    assert len(files.read_odometry(path)) == 60
