"""Matching, RANSAC and the rigid fit: known motions come back, false matches are rejected."""

from __future__ import annotations

import math
from dataclasses import replace

import floor_pictures
import numpy as np
import pytest

from slamcli.core.config import FeatureOptions, MatchOptions
from slamcli.core.geometry import Pose2, apply_homography
from slamcli.core.records import Features
from slamcli.stages import align, features
from slamcli.stages.align.models import MODELS, sound_samples

RIGID = Pose2(0.3, -0.2, 0.7)
TRANSFORMS = {
    "rigid": RIGID.matrix,
    "similarity": RIGID.matrix @ np.diag([1.7, 1.7, 1.0]),
    "affine": np.array([[1.1, 0.3, 0.4], [-0.2, 0.8, -1.0], [0.0, 0.0, 1.0]]),
    "homography": np.array([[1.1, 0.3, 0.4], [-0.2, 0.8, -1.0], [0.05, -0.08, 1.0]]),
}


def pairs_under(transform, inliers, outliers, sigma=0.001, seed=0):
    """Points of a and of b in a square of two metres; the outliers, last, are anywhere."""
    generator = np.random.default_rng(seed)
    b = generator.uniform(-1.0, 1.0, (inliers + outliers, 2))
    a = apply_homography(transform, b) + generator.normal(0.0, sigma, b.shape)
    a[inliers:] = generator.uniform(-2.0, 2.0, (outliers, 2))
    return a, b


def make_features(points, descriptors, sigma=0.001, norm="hamming"):
    return Features(
        np.asarray(points, np.float32),
        np.asarray(descriptors),
        np.ones(len(points), np.float32),
        np.full((len(points), 2), sigma, np.float32),
        np.ones(len(points), np.float32),
        np.full(len(points), np.nan, np.float32),
        norm,
    )


@pytest.mark.parametrize("name", list(TRANSFORMS))
def test_every_model_comes_back_from_half_outliers(name):
    a, b = pairs_under(TRANSFORMS[name], 150, 150)
    found = align.ransac(a, b, MODELS[name], 0.004)
    assert found is not None
    assert found.inliers[:150].mean() > 0.97
    assert found.inliers[150:].mean() < 0.02
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    miss = apply_homography(found.a_from_b, corners) - apply_homography(TRANSFORMS[name], corners)
    assert np.abs(miss).max() < 0.001
    again = align.ransac(a, b, MODELS[name], 0.004)
    assert again is not None
    assert np.array_equal(found.a_from_b, again.a_from_b)


@pytest.mark.parametrize("name", list(TRANSFORMS))
def test_a_minimal_sample_determines_each_model_exactly(name):
    model = MODELS[name]
    b = np.array([[0.0, 0.0], [1.0, 0.1], [0.9, 1.2], [-0.3, 0.8]])[: model.sample_size]
    a = apply_homography(TRANSFORMS[name], b)
    fitted = model.fit(a[None], b[None], np.ones((1, len(b))))[0]
    np.testing.assert_allclose(fitted / fitted[2, 2], TRANSFORMS[name], atol=1e-7)


def test_weights_decide_between_pairs_that_disagree():
    b = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]] * 2)
    a = b + np.repeat([[0.0, 0.0], [0.1, 0.0]], 4, axis=0)
    weights = np.repeat([3.0, 1.0], 4)
    for name in TRANSFORMS:
        fitted = MODELS[name].fit(a[None], b[None], weights[None])[0]
        moved = apply_homography(fitted, [[0.5, 0.5]])[0]
        np.testing.assert_allclose(moved, [0.525, 0.5], atol=2e-4, err_msg=name)


@pytest.mark.parametrize(("each", "others"), [(20, 0), (6, 60)], ids=["at once", "in turn"])
def test_equal_inlier_counts_are_decided_by_net_distance(each, others):
    # Two groups are shifted rigidly, one of them only roughly, both within the threshold. Among
    # many others, the groups are not found in one batch of samples.
    generator = np.random.default_rng(0)
    b = generator.uniform(-1.0, 1.0, (2 * each + others, 2))
    a = generator.uniform(-9.0, 9.0, b.shape)
    a[: 2 * each] = b[: 2 * each] + np.repeat([[1.0, 0.0], [-1.0, 0.0]], each, axis=0)
    a[:each] += np.where(np.arange(each)[:, None] % 2, 0.004, -0.004)
    for seed in range(6):
        found = align.ransac(a, b, MODELS["rigid"], 0.02, seed=seed)
        assert found is not None
        assert found.inliers.sum() == each
        assert found.a_from_b[0, 2] == pytest.approx(-1.0, abs=1e-6)


def test_samples_that_say_nothing_are_not_fitted():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    thresholds = np.full((1, 4), 0.01)

    def sound(name, a, b):
        model = MODELS[name]
        size = model.sample_size
        return bool(sound_samples(a[None, :size], b[None, :size], thresholds, model)[0])

    for name in TRANSFORMS:
        assert sound(name, square, square)
        assert not sound(name, square * 0.005, square), "closer than the threshold"
    assert not sound("rigid", square * 1.1, square)
    assert sound("similarity", square * 1.1, square)
    in_line = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.01], [0.0, 1.0]])
    assert not sound("affine", square, in_line)
    assert not sound("affine", square * (1.0, -1.0), square), "mirrored"
    # Seen through the floor: two corners change sides.
    assert not sound("homography", square[[0, 1, 3, 2]], square)


@pytest.mark.parametrize("name", ["similarity", "affine", "homography"])
def test_shrinking_everything_to_a_point_gains_nothing(name):
    # 79 of 96 matches end in one spot of a: a scale of 0.001 explains them in a, but not in b.
    generator = np.random.default_rng(1)
    b = generator.uniform(-1.0, 1.0, (96, 2))
    a = np.array([0.4, 0.3]) + generator.normal(0.0, 0.007, b.shape)
    a[79:] = generator.uniform(-1.0, 1.0, (17, 2))
    found = align.ransac(a, b, MODELS[name], 0.012)
    assert found is None or found.inliers.sum() < 12


@pytest.mark.parametrize("name", list(TRANSFORMS))
def test_a_mirror_is_never_a_fit(name):
    a, b = pairs_under(np.diag([-1.0, 1.0, 1.0]), 100, 0, sigma=0.0)
    found = align.ransac(a, b, MODELS[name], 0.003)
    assert found is None or found.inliers.sum() < 12


def test_too_few_or_coincident_pairs_determine_nothing():
    nothing = np.zeros((0, 2))
    assert align.ransac(nothing, nothing, MODELS["rigid"], 0.01) is None
    same = np.ones((20, 2))
    for model in MODELS.values():
        assert align.ransac(same, same, model, 0.01, max_iterations=500) is None


def test_a_threshold_for_each_pair():
    b = np.random.default_rng(2).uniform(-1.0, 1.0, (60, 2))
    a = b.copy()
    a[40:, 0] += 0.05
    thresholds = np.full(60, 0.01)
    thresholds[50:] = 0.1
    found = align.ransac(a, b, MODELS["rigid"], thresholds)
    assert found is not None
    assert found.inliers[:40].all()
    assert not found.inliers[40:50].any()
    assert found.inliers[50:].all()


@pytest.mark.parametrize("larger", [1.0, 2.0, 10.0])
def test_the_covariance_of_a_rigid_fit_matches_its_errors(larger):
    # Far points know their range badly, one in ten matches is wrong by up to some centimetres, and
    # the errors are larger than their sigmas say. Three degrees of freedom: NEES 3.
    generator = np.random.default_rng(3)
    truth = Pose2(0.12, -0.03, 0.2)
    squared = []
    for _ in range(200):
        b = np.column_stack([generator.uniform(0.2, 1.0, 80), generator.uniform(-0.4, 0.4, 80)])
        a = truth.apply(b)
        noisy = []
        sigmas = []
        for points in (a, b):
            reach = np.linalg.norm(points, axis=1)
            along = points / reach[:, None]
            across = np.column_stack([-along[:, 1], along[:, 0]])
            sigma = np.column_stack([0.004 * reach**2, 0.0005 * reach])
            errors = generator.normal(0.0, larger * sigma)
            noisy.append(points + errors[:, :1] * along + errors[:, 1:] * across)
            sigmas.append(sigma)
        noisy[0][:8] += larger * generator.uniform(-0.02, 0.02, (8, 2))
        fit = align.fit_rigid(*noisy, *sigmas, truth @ Pose2(0.002, 0.002, 0.002))
        assert fit is not None
        error = fit.a_from_b.inverse() @ truth
        tangent = np.array([error.x, error.y, error.theta])
        squared.append(tangent @ np.linalg.solve(fit.covariance, tangent))
    assert 2.3 < np.mean(squared) < 4.2


def test_equal_pictures_do_not_make_a_motion_perfectly_known():
    points = np.random.default_rng(4).uniform(-1.0, 1.0, (100, 2))
    sigmas = np.full((100, 2), 0.001)
    fit = align.fit_rigid(points, points, sigmas, sigmas, Pose2())
    assert fit is not None
    assert fit.a_from_b.translation_length < 1e-9
    sigma = math.sqrt(fit.covariance[0, 0])
    # A hundred points of sqrt(2) mm: 0.14 mm by the sigmas given; a tenth of it is the lower limit.
    assert 1e-5 < sigma < 1.5e-4


def test_matches_by_ratio_by_cross_check_and_by_cost():
    def bits(*counts):
        rows = np.zeros((len(counts), 32), np.uint8)
        for row, count in zip(rows, counts, strict=True):
            row[: count // 8] = 255
            row[count // 8] = (1 << count % 8) - 1
        return rows

    points = np.zeros((3, 2))
    a = make_features(points, bits(0, 100, 110))
    b = make_features(points, bits(4, 103, 240))
    by_ratio, distances = align.match_descriptors(a, b, MatchOptions(ratio=0.5))
    # 110 is seven bits from 103 too, but 100 is nearer to it, and a point is used once.
    assert by_ratio.tolist() == [[0, 0], [1, 1]]
    assert distances.tolist() == [4.0, 3.0]
    strict, _ = align.match_descriptors(a, b, MatchOptions(ratio=0.035))
    assert strict.tolist() == [[1, 1]]
    crossed, _ = align.match_descriptors(a, b, MatchOptions(filter="cross-check"))
    assert crossed.tolist() == [[0, 0], [1, 1]]
    cheap, _ = align.match_descriptors(a, b, MatchOptions(ratio=0.5, max_distance=3.0))
    assert cheap.tolist() == [[1, 1]]
    none, _ = align.match_descriptors(a, make_features(points[:0], bits()), MatchOptions())
    assert none.shape == (0, 2)


def test_a_guess_keeps_matches_near_it():
    generator = np.random.default_rng(5)
    descriptors = generator.integers(0, 256, (40, 32), np.uint8)
    points = generator.uniform(-1.0, 1.0, (40, 2))
    b = make_features(points, descriptors)
    a = make_features(
        RIGID.apply(points) + np.where(np.arange(40)[:, None] < 30, 0, 0.5), descriptors
    )
    options = MatchOptions(search_radius=0.05, search_angle_radians=0.0)
    near, _ = align.match_descriptors(a, b, options, RIGID.matrix)
    assert set(range(30)) <= set(near[:, 0].tolist())
    far_expected = RIGID.apply(points[near[:, 1]])
    assert np.all(np.linalg.norm(a.points[near[:, 0]] - far_expected, axis=1) <= 0.05)
    # Without a radius of the user's: a hundred sigmas of 1 mm.
    usual, _ = align.match_descriptors(a, b, MatchOptions(search_angle_radians=0.0), RIGID.matrix)
    assert set(range(30)) <= set(usual[:, 0].tolist())
    far_expected = RIGID.apply(points[usual[:, 1]])
    assert np.all(np.linalg.norm(a.points[usual[:, 0]] - far_expected, axis=1) <= 0.1)
    turned = RIGID @ Pose2(0.0, 0.0, 0.2)
    assert len(align.match_descriptors(a, b, options, turned.matrix)[0]) < 10
    loose = replace(options, search_angle_radians=0.25)
    assert len(align.match_descriptors(a, b, loose, turned.matrix)[0]) >= 30


def test_a_rigid_motion_of_asphalt_to_a_twentieth_of_a_pixel():
    floor = floor_pictures.asphalt(1200)
    for seed, motion in enumerate([Pose2(80.4, -35.2, 0.3), Pose2(-10.0, 120.7, -2.0)]):
        views = [
            floor_pictures.look(floor, pose, seed=2 * seed + number)
            for number, pose in enumerate([Pose2(), motion])
        ]
        found = [features.extract(v, floor_pictures.top_down(), FeatureOptions()) for v in views]
        fit = align.align(*found, MatchOptions())
        assert fit.accepted
        assert fit.pose is not None
        error = fit.pose.inverse() @ motion
        assert error.translation_length < 0.05
        assert abs(error.theta) < 2e-4
        nearly = align.align(*found, MatchOptions(), motion @ Pose2(3.0, -3.0, 0.02))
        assert nearly.accepted
        assert nearly.inlier_count >= fit.inlier_count


@pytest.fixture
def agreeing():
    """Sixty features of b, and the same moved in a."""
    generator = np.random.default_rng(6)
    descriptors = generator.integers(0, 256, (60, 32), np.uint8)
    points = generator.uniform(-1.0, 1.0, (60, 2))
    return make_features(RIGID.apply(points), descriptors), make_features(points, descriptors)


def test_a_sound_fit_is_accepted(agreeing):
    fit = align.align(*agreeing, MatchOptions())
    assert fit.accepted
    assert fit.inlier_count == 60
    assert fit.spread == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(fit.a_from_b, RIGID.matrix, atol=1e-6)
    assert fit.covariance is not None


def test_too_few_features_or_matches_are_rejected(agreeing):
    fit = align.align(*agreeing, MatchOptions(min_inliers=61))
    assert fit.reason == "60 and 60 features; at least 61 of each are needed"
    a, b = agreeing
    strangers = np.random.default_rng(10).integers(0, 256, b.descriptors.shape, np.uint8)
    fit = align.align(a, replace(b, descriptors=strangers), MatchOptions(ratio=0.5))
    assert fit.reason == "0 matches; at least 12 are needed"
    assert fit.a_from_b is None
    assert math.isnan(fit.median_residual)


def test_few_inliers_among_many_matches_are_rejected(agreeing):
    a, b = agreeing
    generator = np.random.default_rng(7)
    points = a.points.copy()
    points[7:] = generator.uniform(-1.0, 1.0, (53, 2))
    fit = align.align(replace(a, points=points), b, MatchOptions())
    assert fit.reason.endswith("inliers of 60 matches; at least 12 are needed")
    points = a.points.copy()
    points[20:] = generator.uniform(-1.0, 1.0, (40, 2))
    fit = align.align(replace(a, points=points), b, MatchOptions(min_inlier_ratio=0.5))
    assert fit.reason.startswith("20 inliers of 60 matches (33%)")


def test_a_crowd_of_inliers_is_rejected(agreeing):
    a, b = agreeing
    generator = np.random.default_rng(8)
    points_b = b.points.copy()
    points_b[:30] = 0.7 + generator.uniform(-0.03, 0.03, (30, 2))
    points_a = generator.uniform(-2.0, 2.0, (60, 2)).astype(np.float32)
    points_a[:30] = RIGID.apply(points_b[:30])
    fit = align.align(replace(a, points=points_a), replace(b, points=points_b), MatchOptions())
    assert "inliers cover" in fit.reason


def test_inliers_that_fill_the_disc_are_chance():
    # Dense random pairs: whatever the shift, some land within the threshold, evenly so.
    generator = np.random.default_rng(9)
    descriptors = generator.integers(0, 256, (400, 32), np.uint8)
    a, b = (make_features(generator.uniform(-1.0, 1.0, (400, 2)), descriptors) for _ in range(2))
    fit = align.align(a, b, MatchOptions(threshold=0.4, max_residual_ratio=0.6))
    assert fit.inlier_count > 12
    assert "no better than by chance" in fit.reason


def test_implausible_scales_and_stretches_are_rejected(agreeing):
    a, b = agreeing
    shrunk = replace(a, points=(a.points * 0.05).astype(np.float32))
    fit = align.align(shrunk, b, MatchOptions(model="similarity", max_scale=8.0))
    assert fit.reason.startswith("a scale of 0.05 among the inliers")
    grown = replace(a, points=(a.points * 20.0).astype(np.float32))
    fit = align.align(grown, b, MatchOptions(model="similarity", max_scale=8.0))
    assert fit.reason.startswith("a scale of 20 among the inliers")
    stretched = replace(b, points=b.points * np.array([3.0, 1.0], np.float32))
    fit = align.align(a, stretched, MatchOptions(model="affine", threshold=0.01))
    assert fit.reason.startswith("a stretch of 3 among the inliers")


def test_two_motions_that_explain_as_much_are_ambiguous(agreeing):
    a, b = agreeing
    other = Pose2(RIGID.x + 0.3, RIGID.y, RIGID.theta)
    points = a.points.copy()
    points[35:] = other.apply(b.points[35:])
    fit = align.align(replace(a, points=points), b, MatchOptions())
    assert fit.reason == "ambiguous: 35 matches agree on one motion and 25 on another"
    points = a.points.copy()
    points[50:] = other.apply(b.points[50:])
    assert align.align(replace(a, points=points), b, MatchOptions()).accepted


def test_matches_that_just_miss_a_motion_are_no_rival_of_it(agreeing):
    # The threshold is 7 mm: 18 mm apart no motion explains both groups, and yet it is one motion.
    a, b = agreeing
    points = a.points.copy()
    points[35:] += np.float32(0.018 / math.sqrt(2.0))
    fit = align.align(replace(a, points=points), b, MatchOptions())
    assert fit.inlier_count == 35
    assert fit.accepted


def test_the_covariance_allows_for_matches_that_err_together(agreeing):
    a, b = agreeing
    points = [features.points.astype(np.float64) for features in agreeing]
    sigmas = [features.sigmas.astype(np.float64) for features in agreeing]
    independent = align.fit_rigid(*points, *sigmas, RIGID)
    covariance = align.align(a, b, MatchOptions()).covariance
    ratio = np.diag(covariance) / np.diag(independent.covariance)
    assert np.all((ratio > 4.0) & (ratio < 6.0))


def test_points_that_look_of_another_size_are_not_paired():
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 2))
    descriptors = np.random.default_rng(1).integers(0, 256, (40, 32), np.uint8)
    a = make_features(points, descriptors)
    sizes = np.where(np.arange(40) % 2, 1.3, 1.5).astype(np.float32)
    for larger, smaller in ((a, replace(a, sizes=sizes)), (replace(a, sizes=sizes), a)):
        pairs, _ = align.match_descriptors(larger, smaller, MatchOptions())
        assert np.array_equal(pairs[:, 0], np.arange(1, 40, 2))
        free = MatchOptions(max_size_ratio=None)
        assert len(align.match_descriptors(larger, smaller, free)[0]) == 40


def test_a_size_is_in_metres_whatever_the_view_resolves():
    floor = floor_pictures.asphalt(700)
    view = floor_pictures.look(floor, Pose2())
    grid = replace(view.grid, metres_per_pixel=0.01)
    for options in (FeatureOptions(), FeatureOptions(method="sift")):
        keypoints = features.detect(view, options)
        found = features.to_features(replace(view, grid=grid), keypoints, floor_pictures.top_down())
        assert np.allclose(found.sizes, 0.01 * keypoints.sizes)


def test_an_inlier_is_turned_as_the_fit_turns():
    a, b = pairs_under(RIGID.matrix, 60, 0)
    descriptors = np.random.default_rng(1).integers(0, 256, (60, 32), np.uint8)
    angles = np.linspace(-3.0, 3.0, 60)
    second = replace(make_features(b, descriptors), angles=angles.astype(np.float32))
    # A full turn more, and half of the points turned as no floor was.
    turned = angles + RIGID.theta - math.tau
    turned[::2] += 1.0
    first = replace(make_features(a, descriptors), angles=turned.astype(np.float32))
    found = align.align(first, second, MatchOptions())
    assert found.accepted
    assert np.array_equal(np.flatnonzero(found.inliers), np.arange(1, 60, 2))
    assert (RIGID.inverse() @ found.pose).translation_length < 0.001
    chance = replace(first, angles=first.angles + np.float32(1.0))
    chance.angles[::2] -= 3.0
    assert not align.align(chance, second, MatchOptions()).accepted
    unknown = replace(chance, angles=np.full(60, np.nan, np.float32))
    assert align.align(unknown, second, MatchOptions()).inlier_count == 60


def test_angles_turn_with_the_robot():
    floor = floor_pictures.asphalt(1200)
    motion = Pose2(12.0, -7.0, 0.6)
    for method in ("orb", "sift"):
        options = FeatureOptions(method=method)
        a, b = (
            features.extract(floor_pictures.look(floor, pose), floor_pictures.top_down(), options)
            for pose in (Pose2(), motion)
        )
        pairs, _ = align.match_descriptors(a, b, MatchOptions())
        near = np.hypot(*(a.points[pairs[:, 0]] - motion.apply(b.points[pairs[:, 1]])).T) < 2.0
        turned = a.angles[pairs[near, 0]] - b.angles[pairs[near, 1]] - motion.theta
        assert np.mean(np.cos(turned) > math.cos(math.radians(30.0))) > 0.97
    upright = features.extract(
        floor_pictures.look(floor, motion),
        floor_pictures.top_down(),
        replace(FeatureOptions(), upright=True),
    )
    assert np.isnan(upright.angles).all()
