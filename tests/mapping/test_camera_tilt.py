"""Which tilt of the camera a link may need: by the features that support it, and by the drive."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hand_made_records import alignment_of, fit_of, frame_of

from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link
from slamcli.mapping import camera_tilt
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult

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
