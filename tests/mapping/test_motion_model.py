"""The motion model, on hand-made graphs: predictions, and windows about them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import top_down_calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link, PoseEstimate, PreparedFrame
from slamcli.core.telemetry import OdometryReading
from slamcli.mapping.backend.pose_graph import PoseGraph, tracked
from slamcli.mapping.backend.sensors import Sensors
from slamcli.mapping.motion_model import MotionModel
from slamcli.mapping.tracking_state import TrackingState

CALIBRATION = top_down_calibration((128, 128))
OPTIONS = MapperOptions(search_angle_degrees=30.0, search_share_of_range=0.25)
STEP_METRES = 0.25 * CALIBRATION.max_range_metres
# Two motions that do not commute: the order of composition matters.
FIRST_MOTION, MOTION = Pose2(1.0, -0.3, -0.6), Pose2(2.0, 0.5, 0.3)


class Drive:
    """Frames 0, 1, ... that repeat one motion from frame 2 on; those of `lost` have no pose."""

    def __init__(
        self, count: int, lost: tuple[int, ...] = (), fragments: tuple[int, ...] = ()
    ) -> None:
        self.graph, self.sensors, self.tracking = PoseGraph(), Sensors(), TrackingState()
        self.model = MotionModel(CALIBRATION, OPTIONS, self.tracking, self.graph, self.sensors)
        self.poses = [Pose2(1.0, -2.0, 0.4)]
        for index in range(count):
            fragment = fragments[index] if fragments else 0
            if index in lost:
                self.graph.set_estimate(PoseEstimate(index, str(index), None, None, "lost"))
            else:
                estimate = tracked(frame(index), self.poses[index], np.eye(3), fragment)
                self.graph.set_estimate(estimate)
                self.model.update(index)
            self.poses.append(self.poses[-1] @ (FIRST_MOTION if index < 2 else MOTION))

    def motion(self, a: int, b: int) -> Pose2:
        return self.poses[a].inverse() @ self.poses[b]


def frame(index: int) -> PreparedFrame:
    return PreparedFrame(index, str(index), float(index), None, None, "")


def assert_near(found: Pose2 | None, expected: Pose2) -> None:
    assert found is not None
    apart = expected.inverse() @ found
    assert apart.translation_length < 1e-9
    assert abs(apart.theta) < 1e-9


def expected_motion(drive: Drive, a: int, b: int) -> Pose2 | None:
    prior = drive.model.prior(frame(a), frame(b))
    return None if prior is None else prior.a_from_b


def test_the_latest_motion_is_repeated() -> None:
    drive = Drive(4)
    assert_near(drive.tracking.motion or Pose2(), MOTION)
    assert drive.tracking.motion_frame == 3
    assert_near(expected_motion(drive, 1, 4), drive.motion(1, 4))


def test_the_latest_motion_is_repeated_across_lost_frames_with_a_spread_that_grows() -> None:
    drive = Drive(8)
    near = drive.model.prior(frame(1), frame(8))
    assert near is not None
    for steps, factor in ((2, 3.0), (4, 10.0)):
        prior = drive.model.prior(frame(1), frame(7 + steps))
        assert prior is not None
        predicted = drive.motion(1, 8)
        for _ in range(steps - 1):
            predicted = predicted @ MOTION
        assert_near(prior.a_from_b, predicted)
        np.testing.assert_allclose(prior.covariance, factor**2 * near.covariance)
    assert drive.model.prior(frame(1), frame(12)) is None


def test_the_motion_from_a_lost_frame_is_the_latest_with_the_spread_of_what_it_varied_since() -> (
    None
):
    drive = Drive(9, lost=(7, 8))
    near = drive.model.prior(frame(6), frame(7))
    assert near is not None
    for start, end, varied in ((7, 8, 2), (7, 9, 2 + 3), (8, 9, 3)):
        prior = drive.model.prior(frame(start), frame(end))
        assert prior is not None
        assert_near(prior.a_from_b, drive.motion(start, end))
        np.testing.assert_allclose(prior.covariance, varied**2 * near.covariance)
    assert drive.model.prior(frame(8), frame(11)) is None


def test_there_is_no_motion_over_a_break_or_to_another_fragment() -> None:
    assert Drive(4, lost=(2,)).tracking.motion is None
    assert Drive(4, fragments=(0, 0, 0, 1)).tracking.motion is None
    drive = Drive(4, fragments=(0, 0, 1, 1))
    assert drive.model.prior(frame(1), frame(4)) is None
    assert_near(expected_motion(drive, 2, 4), drive.motion(2, 4))


def test_a_link_predicts_the_motion_from_other_keyframes_of_its_fragment() -> None:
    drive = Drive(4, fragments=(1, 0, 0, 0))
    link = Link(3, 4, drive.motion(3, 4), np.eye(3), 30, 0.9, "step")
    assert_near(drive.model.predict_from_link(frame(1), link), drive.motion(1, 4))
    assert drive.model.predict_from_link(frame(0), link) is None


def test_a_window_follows_the_latest_motion_and_grows_with_the_steps() -> None:
    drive = Drive(4)
    for steps in (1, 2):
        window = drive.model.window(frame(1), frame(3 + steps))
        assert window is not None
        if len(drive.poses) <= 3 + steps:
            drive.poses.append(drive.poses[-1] @ MOTION)
        assert_near(window.centre, drive.motion(1, 3 + steps))
        expected = steps * (STEP_METRES + MOTION.translation_length)
        assert window.radius_metres == pytest.approx(expected)
        assert window.angle_radians == pytest.approx(math.radians(30.0))
    # Too wide: pixels alone are no proof.
    assert drive.model.window(frame(1), frame(3 + 8)) is None


def test_without_a_motion_only_frames_that_follow_each_other_are_searched() -> None:
    drive = Drive(1)
    window = drive.model.window(frame(0), frame(2))
    assert window is not None
    assert math.isinf(window.radius_metres)
    assert drive.model.window(frame(0), frame(3)) is None


def test_odometry_replaces_the_latest_motion() -> None:
    drive = Drive(4)
    slower = Pose2(1.0, 0.1, -0.2)
    pose = Pose2(7.0, 7.0, 1.0)
    for index in range(8):
        drive.sensors.odometry(OdometryReading(float(index), pose))
        pose = pose @ slower
    window = drive.model.window(frame(3), frame(4))
    assert window is not None
    assert_near(window.centre, slower)
    link = drive.model.by_odometry(3, frame(4))
    assert link is not None
    sigma = math.sqrt(link.covariance[:2, :2].max())
    assert window.radius_metres == pytest.approx(STEP_METRES + 3.0 * sigma)
    lost = drive.model.window_after_lost(frame(3), frame(4))
    assert lost is not None
    assert_near(lost.centre, slower)


def test_a_frame_after_a_lost_one_is_searched_one_motion_further_on() -> None:
    drive = Drive(5, lost=(4,))
    window = drive.model.window_after_lost(frame(4), frame(5))
    assert window is not None
    assert_near(window.centre, MOTION)
    assert window.radius_metres == pytest.approx(STEP_METRES + MOTION.translation_length)


def test_a_lost_frame_is_searched_between_its_neighbours() -> None:
    drive = Drive(4, lost=(2,))
    window = drive.model.window_back(frame(3), frame(2))
    assert window is not None
    back = drive.motion(3, 1)
    assert window.centre.x == pytest.approx(0.5 * back.x)
    assert window.centre.theta == pytest.approx(0.5 * back.theta)
    assert window.radius_metres == pytest.approx(STEP_METRES + 0.5 * back.translation_length)
    apart = Drive(4, lost=(2,), fragments=(0, 0, 0, 1)).model.window_back(frame(3), frame(2))
    assert apart is not None
    assert math.isinf(apart.radius_metres)


def test_the_spread_of_the_motion_is_learned_from_the_latest_predictions() -> None:
    """Wide until four predictions came; then two medians of their errors, and a least."""
    sigmas = [np.sqrt(np.diag(covariance_of(count))) for count in (5, 6, 12)]
    for wide in sigmas[:1]:
        assert wide == pytest.approx([STEP_METRES, STEP_METRES, math.radians(30.0)])
    # Frame 2 changed the motion; the predictions after it are right.
    for narrow in sigmas[1:]:
        metres = 0.01 * CALIBRATION.max_range_metres
        assert narrow == pytest.approx([metres, metres, 0.01])
    drive = Drive(12)
    drive.tracking.prediction_errors[:] = [(3.0, 0.1)] * 3 + [(5.0, 0.2)] * 4
    prior = drive.model.prior(frame(1), frame(12))
    assert prior is not None
    assert np.sqrt(np.diag(prior.covariance)) == pytest.approx([10.0, 10.0, 0.4])


def covariance_of(count: int) -> Float64Array:
    prior = Drive(count).model.prior(frame(1), frame(count))
    assert prior is not None
    return prior.covariance
