"""Sparse views: what is read from the picture is what a painted view shows there."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import make_photographer, take

from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.records import Frame, PreparedFrame
from slamcli.mapping.mapper import Mapper
from slamcli.simulation.config import CameraOptions
from slamcli.stages.dense import pyramid, sparse_view

# The far part of its view is coarser in the picture than in the view, the near part finer.
CAMERA = CameraOptions(size=(400, 300), height_metres=0.2, pitch_degrees=45.0)


@pytest.fixture(scope="module")
def prepared() -> PreparedFrame:
    photographer = make_photographer(camera=CAMERA)
    picture = take(photographer, Pose2(0.1, 0.2, 0.3), 0)
    return Mapper(photographer.calibration).prepare(Frame(0, "0", None, picture))


@pytest.fixture(scope="module")
def places(prepared: PreparedFrame) -> pyramid.Places:
    """Return where the finest level has its strongest gradients."""
    level = prepared.levels[0]
    pixels = apply_homography(level.pixel_from_metres, level.points)
    return pyramid.Places.of(pixels.T).among(level.inside)


def test_the_detail_is_that_of_the_painted_view(
    prepared: PreparedFrame, places: pyramid.Places
) -> None:
    sparse = prepared.sparse.value
    assert sparse is not None
    painted = sparse_view.detail_at(prepared.levels[0], places)
    read = sparse_view.detail_at(sparse.finest, places)
    assert np.corrcoef(read, painted)[0, 1] > 0.97
    assert np.std(read) == pytest.approx(np.std(painted), rel=0.1)
    assert abs(np.mean(read - painted)) < 0.1 * np.std(painted)
    # A pixel beside it is another place.
    beside = pyramid.Places(places.maps + np.float32(1.0), places.chosen)
    assert np.corrcoef(sparse_view.detail_at(sparse.finest, beside), painted)[0, 1] < 0.9


def test_the_slopes_are_those_of_the_painted_view(
    prepared: PreparedFrame, places: pyramid.Places
) -> None:
    sparse = prepared.sparse.value
    assert sparse is not None
    painted = sparse_view.slopes_at(prepared.levels[0], places)
    for read, expected in zip(sparse_view.slopes_at(sparse.finest, places), painted, strict=True):
        assert np.corrcoef(read, expected)[0, 1] > 0.9
        assert np.std(read) == pytest.approx(np.std(expected), rel=0.25)


def test_the_second_level_is_that_of_the_painted_view(prepared: PreparedFrame) -> None:
    sparse = prepared.sparse.value
    assert sparse is not None
    painted, read = prepared.levels[1], sparse.second
    np.testing.assert_allclose(read.pixel_from_metres, painted.pixel_from_metres, rtol=1e-9)
    np.testing.assert_array_equal(read.mask, painted.mask)
    seen = painted.inside == 255
    assert np.corrcoef(read.detail[seen], painted.detail[seen])[0, 1] > 0.97
