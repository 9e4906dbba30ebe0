"""An adjustment applied to a registered drive: poses, scale, links and the camera's sigmas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from matched_drives import CHANGE, TRUE

from slamcli.core.camera.calibration import Rocking
from slamcli.core.config import FeatureOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import FloorMap, Link, PoseEstimate
from slamcli.selfcal.apply import apply_adjustment, describe_change
from slamcli.selfcal.bundle import RegisteredDrive
from slamcli.stages import adjustment

SIGMAS = np.array([1e-3, 1e-3, 0.0, 2e-3, 3e-3, 0.0, 0.0])
MOVED = Pose2(1.0, 0.5, 0.3)


def estimate(index, pose, fragment=0):
    status = "lost" if pose is None else "tracked"
    covariance = None if pose is None else np.eye(3)
    return PoseEstimate(index, f"{index}.png", None, pose, status, "", fragment, covariance)


def registered():
    """Two maps and a lost frame; of the first map only frames 0 and 2 have matches."""
    poses = [Pose2(0.1 * index, 0.0, 0.0) for index in range(4)]
    estimates = [estimate(index, pose) for index, pose in enumerate(poses)]
    estimates += [estimate(4, None, -1), estimate(5, Pose2(2.0, 0.0, 0.0), 1)]
    link = Link(0, 1, Pose2(0.1, 0.0, 0.2), np.eye(3), 50, 1.0, "step")
    placed = [one for one in estimates if one.map_from_robot is not None]
    floor_map = FloorMap(TRUE, FeatureOptions(), 0.001, 0.1, (), tuple(placed), (link,))
    return RegisteredDrive(TRUE, estimates, [link], frozenset(), floor_map)


def adjusted(sigmas=SIGMAS):
    poses = {
        0: adjustment.FramePose(Pose2(), Rocking()),
        2: adjustment.FramePose(MOVED, Rocking(0.01, 0.02, 0.003)),
    }
    return adjustment.Adjustment(
        adjustment.changed(TRUE, CHANGE),
        poses,
        CHANGE,
        np.diag(np.asarray(sigmas) ** 2),
        {0: np.zeros((3, 3)), 2: np.diag([4.0, 4.0, 1.0])},
        np.zeros(3),
        1.0,
        0.0,
    )


def test_adjusted_frames_take_their_pose_and_rocking_at_the_true_scale():
    done = apply_adjustment(registered(), adjusted(), 2.0)
    second = done.estimates[2]
    assert second.map_from_robot == Pose2(2.0, 1.0, 0.3)
    assert second.rocking == Rocking(0.01, 0.02, 0.006)
    np.testing.assert_allclose(np.diag(second.covariance), [16.0, 16.0, 1.0], rtol=1e-9)


def test_a_frame_without_matches_moves_with_the_nearest_of_its_map():
    done = apply_adjustment(registered(), adjusted(), 1.0)
    third = done.estimates[3].map_from_robot
    expected = MOVED @ Pose2(0.1, 0.0, 0.0)
    assert (third.x, third.y, third.theta) == pytest.approx(
        (expected.x, expected.y, expected.theta)
    )
    # Another map shares no matches with this one, and a lost frame has no pose to move.
    assert done.estimates[5].map_from_robot == Pose2(2.0, 0.0, 0.0)
    assert done.estimates[4].map_from_robot is None


def test_the_map_is_of_the_adjusted_camera_and_its_links_have_the_true_scale():
    done = apply_adjustment(registered(), adjusted(), 2.0)
    assert done.floor_map.calibration is done.calibration
    assert done.floor_map.estimates == tuple(e for e in done.estimates if e.index != 4)
    for link in (*done.floor_map.links, *done.links):
        assert link.a_from_b == Pose2(0.2, 0.0, 0.2)
        np.testing.assert_array_equal(np.diag(link.covariance), [4.0, 4.0, 1.0])


def test_links_between_adjusted_frames_are_the_motions_between_their_poses():
    drive = registered()
    links = [
        Link(0, 2, Pose2(0.2, 0.0, 0.0), np.eye(3), 50, 1.0, kind)
        for kind in ("step", "loop", "odometry", "loop")
    ]
    # What is measured by other sensors stays, and so does a link that the others contradict.
    drive = replace(drive, links=links, switched_off=frozenset({3}))
    motions = [link.a_from_b for link in apply_adjustment(drive, adjusted(), 1.0).links]
    assert motions == [MOVED, MOVED, Pose2(0.2, 0.0, 0.0), Pose2(0.2, 0.0, 0.0)]


def test_the_adjusted_camera_carries_its_sigmas_and_the_true_height():
    found = apply_adjustment(registered(), adjusted(), 2.0).calibration
    assert found.height_metres == pytest.approx(2.0 * TRUE.height_metres)
    assert found.focal_sigma_pixels == pytest.approx(1e-3 * found.camera_matrix[0, 0])
    assert found.pitch_sigma_radians == pytest.approx(2e-3)
    assert found.roll_sigma_radians == pytest.approx(3e-3)


def test_a_camera_that_was_fixed_is_returned_as_it_was():
    assert apply_adjustment(registered(), adjusted(np.zeros(7)), 1.0).calibration is TRUE


def test_a_change_is_described_with_its_sigmas():
    after = apply_adjustment(registered(), adjusted(), 1.0).calibration
    text = describe_change(TRUE, after)
    focal = TRUE.camera_matrix[0, 0]
    assert f"focal length {focal:.1f} to {focal * math.exp(0.02):.1f} ± " in text
    assert "pitch 38.00 to 38.50 ± 0.11°" in text
