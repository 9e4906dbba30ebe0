"""A frame that is seen from another side than all others."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flights import FOCAL, RADIUS, floor_picture, photographs

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.geometry import apply_homography, invert
from slamcli.survey import survey, survey_features
from slamcli.survey.lens import Lens
from slamcli.survey.projection import LOG_SCALE, PITCH, ROLL, STATES, project
from slamcli.survey.slanted import slanted_features, slanted_pairs


def frames_from_two_sides() -> tuple[Float64Array, list[UInt8Array]]:
    """Return the states and pictures of four frames from one side, and of one from another."""
    states = np.zeros((5, STATES))
    states[:, 0], states[:, 1] = (300, 345, 390, 435, 380), -450
    states[:, PITCH], states[4, PITCH] = math.radians(20.0), 0.0
    states[4, ROLL], states[4, LOG_SCALE] = math.radians(54.0), 0.1
    pictures = photographs(floor_picture(), states)
    noise = np.random.default_rng(1).normal(0.0, 25.0, pictures[4].shape)
    pictures[4] = np.clip(pictures[4] + noise, 0, 255).astype(np.uint8)
    return states, pictures


def test_tilted_views_of_a_frame_match_frames_from_another_side() -> None:
    states, pictures = frames_from_two_sides()
    features = [survey_features(picture) for picture in pictures]
    pairs = slanted_pairs(4, slanted_features(pictures[4]), features)
    assert len(pairs) >= 3
    image_from_map = project(states, FOCAL).image_from_map
    for pair in pairs:
        a_from_b = image_from_map[pair.a] @ invert(image_from_map[pair.b])
        errors = np.linalg.norm(apply_homography(a_from_b, pair.pixels_b) - pair.pixels_a, axis=1)
        assert np.median(errors) < 1.0


@pytest.mark.slow
def test_a_frame_from_another_side_is_placed_by_tilted_views_of_it() -> None:
    _, pictures = frames_from_two_sides()
    features = [survey_features(picture) for picture in pictures]
    lens = Lens(FOCAL, 0.0, RADIUS)
    assert [one.frames for one in survey(features, lens).maps] == [(0, 1, 2, 3)]
    found = survey(features, lens, slanted=lambda n: slanted_features(pictures[n]))
    assert [one.frames for one in found.maps] == [(0, 1, 2, 3, 4)]
