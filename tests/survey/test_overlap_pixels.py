"""Overlaps whose pixels show unrelated floor: copied texture, and relief, which is none."""

from __future__ import annotations

import cv2
import numpy as np
from flights import FOCAL, RADIUS, SIZE, floor_picture

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.survey import SurveyFeatures, survey, survey_features
from slamcli.survey.lens import Lens
from slamcli.survey.overlap_pixels import MAX_UNRELATED_SHARE, unrelated_share
from slamcli.survey.pairs import find_pair

WIDTH, HEIGHT = SIZE
STEP = 150


def frame(floor: UInt8Array, left: int, top: int = 0) -> SurveyFeatures:
    """Return the features of a part of a floor."""
    return survey_features(np.ascontiguousarray(floor[top : top + HEIGHT, left : left + WIDTH]))


def shift(x: float, y: float) -> Float64Array:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def test_a_copied_patch_is_no_pair() -> None:
    first, second = floor_picture(seed=1), floor_picture(seed=2)
    second[40:120, 60:150] = first[40:120, 60:150]
    found = find_pair(0, 1, frame(first, 0), frame(second, 0))
    assert found.reason == "pixels of the overlap differ"
    assert unrelated_share(frame(first, 0), frame(second, 0), np.eye(3)) > MAX_UNRELATED_SHARE


def test_relief_is_no_unrelated_floor() -> None:
    floor = floor_picture()
    rows, columns = np.indices((HEIGHT, WIDTH)).astype(np.float32)
    # Parallax of up to 5 pixels, as over stones and dunes.
    parallax = 5 * np.sin(columns / 35) * np.cos(rows / 30)
    moved = cv2.remap(floor, columns + 40 + parallax, rows, cv2.INTER_LINEAR)
    first, second = frame(floor, 0), survey_features(np.asarray(moved, np.uint8))
    assert unrelated_share(first, second, shift(40.0, 0.0)) < 0.5 * MAX_UNRELATED_SHARE
    assert unrelated_share(first, second, shift(100.0, 60.0)) > 2.0 * MAX_UNRELATED_SHARE


def test_strips_that_only_copied_texture_joins_are_two_maps() -> None:
    first, second = floor_picture(seed=1), floor_picture(seed=2)
    # All that frame 1 shares with a frame of the other strip is a copy; nothing else is.
    band = slice(STEP, STEP + WIDTH)
    second[:70, band] = first[HEIGHT - 70 : HEIGHT, band]
    strips = [[frame(floor, STEP * number) for number in range(3)] for floor in (first, second)]
    joined = find_pair(0, 1, strips[0][1], strips[1][1])
    assert not joined.reason
    found = survey([*strips[0], *strips[1]], Lens(FOCAL, 0.0, RADIUS))
    assert [one.frames for one in found.maps] == [(0, 1, 2), (3, 4, 5)]
    assert (1, 4) in {(pair.a, pair.b) for pair in found.contradicted}
