"""The quick test whether frames contradict their calibration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from matched_drives import CHANGE, POSES, TRUE, WRONG, observe

from slamcli.core.records import Link, PoseEstimate
from slamcli.selfcal import RegisteredDrive, contradiction, contradiction_pixels, contradicts
from slamcli.stages import adjustment

MATCHES = {(match.a, match.b): match for match in observe(TRUE, POSES, {}, 0.1)}


def registered(calibration, pairs=tuple(MATCHES)):
    estimates = [
        PoseEstimate(index, f"{index}.png", None, pose, "tracked", "", 0, np.eye(3))
        for index, pose in POSES.items()
    ]
    links = [
        Link(a, b, POSES[a].inverse() @ POSES[b], np.eye(3), 50, 1.0, "step") for a, b in pairs
    ]
    return RegisteredDrive(calibration, estimates, links)


@pytest.fixture
def pixels(monkeypatch):
    """Return what the test finds where the frames' matches are those of the true camera."""

    class Observed:
        def __init__(self, *_arguments):
            self.asked = []

        def match(self, pair, count):
            return MATCHES[pair]

    monkeypatch.setattr(contradiction, "Matcher", Observed)

    def run(drive):
        return contradiction_pixels(drive, lambda index: pytest.fail(f"{index} was read"), map)

    return run


def test_a_camera_that_is_right_is_not_contradicted(pixels):
    found = pixels(registered(TRUE))
    assert found < 0.2
    assert not contradicts(found)


def test_a_lens_that_is_not_known_and_a_wrong_focal_length_are_contradicted(pixels):
    lens = adjustment.changed(TRUE, np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    focal = adjustment.changed(TRUE, np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for camera in (lens, focal, WRONG):
        assert contradicts(pixels(registered(camera)))
    assert np.any(CHANGE)


def test_with_too_few_pairs_nothing_is_concluded(pixels):
    found = pixels(registered(WRONG, tuple(MATCHES)[:2]))
    assert math.isnan(found)
    assert not contradicts(found)


def test_without_a_calibration_there_is_nothing_to_contradict(pixels):
    assert math.isnan(pixels(registered(replace(TRUE, height_metres=math.nan))))
