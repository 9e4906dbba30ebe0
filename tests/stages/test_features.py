"""Points are where they are said to be, spread, and off what was not seen."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import floor_pictures
import numpy as np
import pytest

from slamcli.core.config import FeatureOptions, MatchOptions
from slamcli.core.errors import InputError
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import View
from slamcli.stages import align, features

ORB = FeatureOptions()
SIFT = FeatureOptions(method="sift")


@pytest.fixture(scope="module")
def floor():
    return floor_pictures.asphalt(1200)


def errors_of_matches(floor, options, motion):
    """(M, 2) pixels by which true matches miss the known motion, and their pyramid levels."""
    first = floor_pictures.look(floor, Pose2(), seed=1)
    second = floor_pictures.look(floor, motion, seed=2)
    found = [features.detect(view, options) for view in (first, second)]
    placed = [
        features.to_features(view, keypoints, floor_pictures.top_down())
        for view, keypoints in zip((first, second), found, strict=True)
    ]
    pairs, _ = align.match_descriptors(*placed, MatchOptions())
    errors = placed[0].points[pairs[:, 0]] - motion.apply(placed[1].points[pairs[:, 1]])
    near = np.hypot(*errors.T) < 4.0
    levels = found[0].octaves[pairs[:, 0]]
    same = near & (levels == found[1].octaves[pairs[:, 1]])
    return errors[same], levels[same]


@pytest.mark.parametrize("degrees", [30.0, 180.0])
def test_refined_orb_is_placed_to_a_tenth_of_a_pixel_on_every_level(floor, degrees):
    # Half a turn doubles any shift of a pyramid level; the spread part of a picture is mostly
    # level 0, so all points are kept.
    motion = Pose2(20.3, -10.7, math.radians(degrees))
    options = replace(ORB, count=1200, spread=False)
    errors, levels = errors_of_matches(floor, options, motion)
    assert len(errors) > 300
    assert np.median(np.hypot(*errors[levels == 0].T)) < 0.12
    for level in range(5):
        here = errors[levels == level]
        assert len(here) > 10
        assert np.abs(np.median(here, axis=0)).max() < 0.12, f"level {level} is shifted"


def test_refinement_beats_whole_pixels_threefold(floor):
    motion = Pose2(20.3, -10.7, 0.5)
    refined, _ = errors_of_matches(floor, ORB, motion)
    whole, _ = errors_of_matches(floor, replace(ORB, refine=False), motion)
    typical = [float(np.median(np.hypot(*errors.T))) for errors in (refined, whole)]
    assert typical[0] < typical[1] / 3.0


def test_sift_is_not_shifted(floor):
    errors, _ = errors_of_matches(floor, SIFT, Pose2(3.0, 2.0, math.pi))
    assert len(errors) > 100
    assert np.abs(np.median(errors, axis=0)).max() < 0.05
    assert np.median(np.hypot(*errors.T)) < 0.15


def test_points_are_spread_over_a_picture_with_one_strong_corner(floor):
    view = floor_pictures.look(floor, Pose2(), noise=0.0)
    image = (128.0 + 0.5 * (view.image - 128.0)).astype(np.uint8)
    image[:120, :120] = view.image[:120, :120]
    view = replace(view, image=image)
    shares = []
    for spread in (True, False):
        pixels = features.detect(view, replace(ORB, count=200, spread=spread)).pixels
        assert len(pixels) == 200
        shares.append(np.mean(np.all(pixels < 120, axis=1)))
    assert shares[0] < 0.2
    assert shares[1] > 0.5


def test_a_floor_of_low_contrast_still_gives_points(floor):
    view = floor_pictures.look(floor, Pose2(), noise=0.0)
    view = replace(view, image=(128.0 + 0.22 * (view.image - 128.0)).astype(np.uint8))
    assert len(features.detect(view, replace(ORB, min_fast_threshold=20))) < 50
    assert len(features.detect(view, ORB)) == ORB.count


@pytest.mark.parametrize("options", [ORB, SIFT], ids=["orb", "sift"])
def test_no_patch_touches_what_was_not_seen(floor, options):
    view = floor_pictures.look(floor, Pose2())
    mask = np.zeros_like(view.mask)
    cv2.circle(mask, (310, 290), 230, 255, -1)
    view = replace(view, image=np.where(mask > 0, view.image, np.uint8(0)), mask=mask)
    found = features.detect(view, options)
    # One pixel of the drawn circle's edge, one of refinement and one of rounding are allowed for.
    inside = 230.0 - np.hypot(*(found.pixels - (310, 290)).T)
    assert np.all(inside > options.roi_border_pixels * np.maximum(found.scales, 1.0) - 3.0)
    assert len(found) > 100
    everywhere = features.detect(view, replace(options, roi=False))
    assert np.min(230.0 - np.hypot(*(everywhere.pixels - (310, 290)).T)) < 10.0


def test_clean_image_lows_passes_then_blackens():
    image = np.full((20, 20), 90, np.uint8)
    image[:, 10:] = 200
    cleaned = features.clean_image(image, 5, 100)
    assert np.all(cleaned[:, :8] == 0)
    # Two columns of the box of five reach over the edge: (3 * 90 + 2 * 200) / 5.
    assert np.all(cleaned[:, 9] == 134)
    assert np.all(cleaned[:, 12:] == 200)


def test_sigmas_grow_with_distance_and_along_the_line_of_sight():
    calibration = floor_pictures.forward_camera()
    grid = Grid(0.0, 0.4, 0.001, 800, 800)
    pixels = np.array([[200.0, 400.0], [600.0, 400.0]])
    found = features.detect(
        View(grid, np.zeros((800, 800), np.uint8), np.zeros((800, 800), np.uint8)), ORB
    )
    keypoints = replace(found, pixels=pixels, sigmas=np.array([0.25, 0.25], np.float32))
    keypoints = replace(keypoints, responses=np.zeros(2, np.float32))
    near, far = features.to_features(_empty(grid), keypoints, calibration).sigmas
    # The camera's pixel at 0.2 m and at 0.6 m: distance over focal length, and the obliqueness.
    for sigma, x in ((near, 0.2005), (far, 0.6005)):
        ray = math.hypot(x, 0.3)
        depth = ray * math.cos(math.atan2(0.3, x) - math.radians(45.0))
        assert sigma[1] == pytest.approx(max(0.25 * depth / 520.0, 0.25e-3), rel=0.01)
    assert far[0] > 1.5 * far[1]
    tilted = features.to_features(_empty(grid), keypoints, calibration, math.radians(0.5)).sigmas
    swing = (0.6005**2 + 0.3**2) / 0.3 * math.radians(0.5)
    assert tilted[1, 0] == pytest.approx(math.hypot(far[0], swing), rel=0.01)
    assert tilted[1, 1] == far[1]


def test_a_picture_without_texture_gives_no_features():
    view = _empty(Grid(0.0, 0.0, 1.0, 200, 100))
    for options in (ORB, SIFT):
        found = features.extract(view, floor_pictures.top_down(), options)
        assert len(found) == 0
        assert found.descriptors.ndim == 2


def test_more_compared_points_change_the_norm(floor):
    view = floor_pictures.look(floor, Pose2())
    assert features.detect(view, replace(ORB, wta_k=2)).norm == "hamming"
    assert features.detect(view, replace(ORB, wta_k=3)).norm == "hamming2"
    assert features.detect(view, SIFT).norm == "l2"


def test_equal_pictures_give_equal_features(floor):
    view = floor_pictures.look(floor, Pose2())
    before = view.image.copy()
    first, second = (features.extract(view, floor_pictures.top_down(), ORB) for _ in range(2))
    for name in ("points", "descriptors", "scores", "sigmas"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert np.array_equal(before, view.image)


def test_levels_that_leave_no_pixel_are_not_built(floor):
    small = floor[:60, :80].copy()
    view = View(Grid(0.0, 0.0, 1.0, 80, 60), small, np.full(small.shape, 255, np.uint8))
    options = replace(ORB, levels=32, scale_factor=2.0, edge_threshold=8, roi=False)
    assert len(features.detect(view, options)) > 0


def test_options_that_contradict_are_refused():
    with pytest.raises(InputError, match="first level of 8 needs more than 8 levels"):
        FeatureOptions(first_level=8)
    with pytest.raises(InputError, match="enlarges pictures"):
        FeatureOptions(first_level=20, levels=24)


def _empty(grid: Grid) -> View:
    image = np.zeros((grid.height, grid.width), np.uint8)
    return View(grid, image, np.full(image.shape, 255, np.uint8))
