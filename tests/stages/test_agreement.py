"""Odometry and compass compared with the frames: faults are named, and good readings are not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.geometry import Pose2, pose_array
from slamcli.core.telemetry import OdometryReading, TelemetryOptions
from slamcli.stages import telemetry

RATE_HERTZ = 10.0


def drive(frames: int, step: float = 0.03) -> list[Pose2]:
    """Of changing speed and turn."""
    poses = [Pose2()]
    for index in range(frames - 1):
        length = step * (1.0 + 0.5 * math.sin(0.8 * index))
        poses.append(poses[-1] @ Pose2(length, 0.0, 0.03 + 0.1 * math.sin(0.5 * index)))
    return poses


def seen(truth: list[Pose2], lost: range = range(0)) -> telemetry.VisualMotions:
    motions = telemetry.VisualMotions()
    for index in range(1, len(truth)):
        if index not in lost and index - 1 not in lost:
            motion = truth[index - 1].inverse() @ truth[index] @ Pose2(0.0001, -0.0001, 0.0002)
            ends = [(n, n / RATE_HERTZ) for n in (index - 1, index)]
            motions.add(ends[0], ends[1], motion)
    return motions


def readings(truth: list[Pose2]) -> tuple[np.ndarray, np.ndarray]:
    """At 50 Hz, by wheels that are 2 % too large, from another origin."""
    stamps, poses = [], []
    for index in range(len(truth) - 1):
        for part in range(5):
            pose = telemetry.interpolate(truth[index], truth[index + 1], part / 5)
            stamps.append((index + part / 5) / RATE_HERTZ)
            poses.append(Pose2(3.0, -1.0, 0.7) @ Pose2(1.02 * pose.x, 1.02 * pose.y, pose.theta))
    return np.array(stamps), pose_array(poses)


def fault_of(stamps: np.ndarray, poses: np.ndarray, motions: telemetry.VisualMotions) -> str:
    track = telemetry.OdometryTrack(TelemetryOptions())
    for stamp, (x, y, theta) in zip(stamps.tolist(), poses.tolist(), strict=True):
        track.add(OdometryReading(stamp, Pose2(x, y, theta)))
    return telemetry.find_fault(*track.arrays(), motions)


ONE = np.ones(3)


@pytest.mark.parametrize("frames", [12, 24, 200])
@pytest.mark.parametrize(
    ("factors", "named"),
    [
        ((1, 1, 1), ""),
        ((1.15, 1.15, 1.1), ""),
        ((1, 1, 180 / math.pi), "headings are in degrees"),
        ((1000, 1000, 1), "lengths are in millimetres"),
        ((100, 100, 1), "lengths are in centimetres"),
        ((3.28, 3.28, 1), "lengths are in feet"),
        ((1.9, 1.9, 1), "lengths are 1.9"),
        ((1, -1, -1), "its y axis and headings are left-handed"),
        ((1, 1, -1), "its headings are left-handed, clockwise"),
        ((1, -1, 1), "its y axis is left-handed"),
        ((1000, -1000, -1), "left-handed: negate both; its lengths are in millimetres"),
    ],
)
def test_units_and_handedness_are_named(
    frames: int, factors: tuple[float, float, float], named: str
) -> None:
    truth = drive(frames)
    stamps, poses = readings(truth)
    found = fault_of(stamps, poses * factors, seen(truth, range(5, 7)))
    assert named in found
    assert bool(named) == bool(found)


@pytest.mark.parametrize(
    ("degrees", "named"), [(90, "turned by -90"), (-90, "turned by 90"), (180, "turned by -180")]
)
def test_a_camera_that_does_not_look_ahead_is_named(degrees: float, named: str) -> None:
    truth = drive(24)
    stamps, poses = readings(truth)
    poses[:, 2] -= math.radians(degrees)
    assert named in fault_of(stamps, poses, seen(truth))


@pytest.mark.parametrize(("late", "advice"), [(0.4, "-0.4"), (-0.7, "0.7"), (1e9, "-1000000000.0")])
def test_a_clock_that_differs_is_named_with_its_offset(late: float, advice: str) -> None:
    truth = drive(60)
    stamps, poses = readings(truth)
    found = fault_of(stamps + late, poses, seen(truth))
    assert "clock" in found
    assert f"--time-offset {advice}" in found


def test_what_nothing_explains_is_named_as_that() -> None:
    truth = drive(60)
    stamps, poses = readings(truth)
    generator = np.random.default_rng(0)
    poses[:, :2] += np.cumsum(0.03 * generator.standard_normal((len(poses), 2)), axis=0)
    assert "no other unit, axis or clock" in fault_of(stamps, poses, seen(truth))


def test_wheels_that_slip_now_and_then_and_even_motion_are_no_fault() -> None:
    truth = drive(100)
    stamps, poses = readings(truth)
    for slip in (100, 200, 300):
        poses[slip:, 0] += 0.4
    assert not fault_of(stamps, poses, seen(truth))
    straight = [Pose2(0.03 * index) for index in range(60)]
    stamps, poses = readings(straight)
    assert not fault_of(stamps + 0.3, poses, seen(straight))
    assert not fault_of(stamps, poses, seen(straight[:3]))
    assert not fault_of(stamps[:1], poses[:1], seen(straight))


def track_of(poses: np.ndarray, rate: float = 50.0) -> telemetry.OdometryTrack:
    track = telemetry.OdometryTrack(TelemetryOptions())
    for index, (x, y, theta) in enumerate(poses.tolist()):
        track.add(OdometryReading(index / rate, Pose2(x, y, theta)))
    return track


def test_a_reset_is_found_and_motions_across_it_are_not_known() -> None:
    _, poses = readings(drive(24))
    anew = poses.copy()
    anew[60:] = pose_array([Pose2(*poses[60]).inverse() @ Pose2(*row) for row in poses[60:]])
    anew[:60] = pose_array([Pose2(*poses[0]).inverse() @ Pose2(*row) for row in poses[:60]])
    track = track_of(anew)
    assert track.resets == [pytest.approx(1.2)]
    assert track.motion(1.0, 1.1) is not None
    assert track.motion(1.21, 1.3) is not None
    for begin, end in ((1.1, 1.3), (1.19, 1.2), (1.0, 1.195)):
        assert track.motion(begin, end) is None
    # A leap to anywhere, and none where the robot only drives, stands, comes back or hurries.
    leaping = poses.copy()
    leaping[60:, 0] += 5.0
    assert track_of(leaping).resets == [pytest.approx(1.2)]
    back = np.concatenate([poses, poses[::-1]])
    still = np.concatenate([np.repeat(poses[:1], 50, axis=0), poses])
    hurried = poses.copy()
    hurried[60:, 0] += np.cumsum(np.full(len(poses) - 60, 0.05))
    for usual in (poses, back, still, hurried):
        assert not track_of(usual).resets


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda h: h, ""),
        (lambda h: h + 1.0, ""),
        (lambda h: np.degrees(h) % 360, "in degrees, not radians"),
        (lambda h: 0.4 - h, "clockwise: name the column bearing"),
        (lambda h: (90 - np.degrees(h)) % 360, "clockwise and in degrees"),
    ],
)
def test_a_compass_in_degrees_or_clockwise_is_named(change: object, named: str) -> None:
    assert callable(change)
    truth = drive(200)
    stamps, poses = readings(truth)
    noise = math.radians(2.0) * np.random.default_rng(1).standard_normal(len(poses))
    found = telemetry.find_heading_fault(stamps, change(poses[:, 2] + noise), seen(truth))
    assert named in found
    assert bool(named) == bool(found)
