"""Which tilt of the camera a link may need: by the features that support it, and by the drive."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hand_made_records import alignment_of, fit_of, frame_of

from slamcli import Mapper
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, Link
from slamcli.mapping import camera_tilt
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult
from slamcli.registration.hypothesis import PyramidPair, score_refined
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import CameraOptions, DisturbanceOptions, FloorOptions
from slamcli.stages import dense

OPTIONS = MapperOptions()  # 0.1 degrees are expected; 36 inliers support a tilt, 120 prove it


def linked(degrees: float, inliers: int) -> RegistrationResult:
    tilted = np.eye(3)
    tilted[2, 0] = degrees
    fit = fit_of(view_a_from_view_b=tilted, tilt_radians=math.radians(degrees))
    link = Link(0, 1, Pose2(0.05), fit.covariance, inliers, 0.99, "step")
    return RegistrationResult(
        frame_of(0), frame_of(1), alignment_of(inliers), link, fit, None, "", 0.0, None, None
    )


def is_kept(degrees: float, inliers: int, shown_degrees: list[float]) -> bool:
    shown = [math.radians(one) for one in shown_degrees]
    result = camera_tilt.without_unusual(linked(degrees, inliers), shown, OPTIONS)
    assert (result.link is None) == (result.reason != "")
    return result.link is not None


@pytest.mark.parametrize(
    ("degrees", "inliers", "shown", "kept"),
    [
        (0.2, 0, [], True),
        (0.4, 0, [], False),
        (0.4, 40, [], True),
        (0.4, 40, [0.0] * 3, True),  # three links show nothing yet
        (0.4, 40, [0.0] * 4, False),  # of a camera that is steady
        (0.05, 0, [0.0] * 4, True),
        (0.2, 0, [0.0] * 4, False),
        (0.4, 0, [0.2, 0.1, 0.3, 0.2], True),  # of one that rocks
        (2.0, 100, [0.2, 0.1, 0.3, 0.2], False),
        (2.0, 150, [0.0] * 4, True),  # over a bump
    ],
)
def test_few_features_support_no_more_tilt_than_the_drive_has_shown(
    degrees: float, inliers: int, shown: list[float], kept: bool
) -> None:
    assert is_kept(degrees, inliers, shown) == kept


def test_a_drive_shows_its_tilt_in_links_of_many_features_or_of_none() -> None:
    tracking = TrackingState()
    for degrees, inliers in [(0.2, 20), (0.3, 40)] + [(0.1, 200)] * 25:
        camera_tilt.add_link(linked(degrees, inliers), tracking, OPTIONS)
    assert tracking.tilts_radians == [math.radians(0.1)] * 20
    tracking.tilts_radians.clear()
    for degrees, inliers in [(0.2, 20), (0.3, 40)]:
        camera_tilt.add_link(linked(degrees, inliers), tracking, OPTIONS)
    assert tracking.tilts_radians == [math.radians(0.3)]
    steady = linked(0.0, 0)
    assert steady.fit is not None
    object.__setattr__(steady.fit, "view_a_from_view_b", steady.fit.pose.matrix)
    camera_tilt.add_link(steady, tracking, OPTIONS)
    assert tracking.tilts_radians == [math.radians(0.3), 0.0]


def test_a_steady_motion_is_refined_with_the_rocking_that_a_drive_has_shown() -> None:
    calibration = photograph.make_camera(CameraOptions(size=(400, 300)))
    floor = floors.make_floor("course", FloorOptions(wear=0.5), 0.001, seed=0)
    photographer = photograph.Photographer(photograph.World(floor), calibration)
    motion, rocking = Pose2(0.05, 0.01, 0.1), DisturbanceOptions(rocking_degrees=0.5)
    a, b = (
        Mapper(calibration).prepare(
            Frame(
                index,
                "",
                None,
                photograph.take(
                    photographer, (pose, pose), 0.0, rocking, np.random.default_rng([1, index])
                ),
            )
        )
        for index, pose in enumerate((Pose2(0.2), Pose2(0.2) @ motion))
    )
    refined = dense.refine(a.levels[:2], b.levels[:2], motion, calibration, 0.0)
    assert refined is not None
    fit = score_refined(PyramidPair(a.levels, b.levels), refined)
    link = Link(0, 1, fit.pose, fit.covariance, 0, 0.99, "step")
    steady = RegistrationResult(a, b, alignment_of(0), link, fit, None, "", 0.0, None, None)
    for degrees in ([0.0] * 4, [0.4] * 3):
        shown = [math.radians(one) for one in degrees]
        assert camera_tilt.with_rocking(steady, shown, calibration, OPTIONS) is steady
    shown = [math.radians(0.4)] * 4
    rocked = camera_tilt.with_rocking(steady, shown, calibration, OPTIONS)
    assert rocked.link is not None
    errors = [motion.inverse() @ one.a_from_b for one in (link, rocked.link)]
    assert errors[0].translation_length > 0.003
    assert errors[1].translation_length < 0.0008
    error = np.array([errors[1].x, errors[1].y, errors[1].theta])
    assert error @ np.linalg.solve(rocked.link.covariance, error) < 16.3
