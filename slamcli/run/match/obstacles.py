"""Obstacles on the floor of two bird's-eye views, and the fit without them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2, invert
from slamcli.core.records import FeatureAlignment, PyramidLevel
from slamcli.run.match.fitting import PairFit, PairImage, compared_views
from slamcli.stages import align, dense, local_correlation

# How far a camera may rock between two pictures, in its tilt sigmas, tried in turn
# [guarded by tests/run/paint/test_obstacles.py].
_ROCKING_TIMES = (0.0, 1.0, 5.0)


def without_obstacles(
    first: PairImage, second: PairImage, fit: PairFit, min_inliers: int
) -> PairFit:
    """Return the fit of two bird's-eye views with the obstacles on their floor.

    Inliers on an obstacle are left out and the motion is fitted again, where at least `min_inliers`
    are left and the pixels of the views then agree better.
    """
    pose = fit.alignment.pose
    if fit.reason or pose is None:
        return fit
    calibration = first.calibration
    levels_a, levels_b = (
        dense.make_levels(compared_views(picture, far=False)[0]) for picture in (first, second)
    )
    view_a_from_view_b = _registered(levels_a, levels_b, pose, calibration)
    marks = (
        dense.find_obstacles(levels_a, levels_b, view_a_from_view_b, calibration),
        dense.find_obstacles(levels_b, levels_a, invert(view_a_from_view_b), calibration),
    )
    matches = fit.alignment.matches
    marked = marks[0].marks(fit.first.points[matches[:, 0]])
    marked |= marks[1].marks(fit.second.points[matches[:, 1]])
    marked &= fit.alignment.inliers
    fit = replace(fit, obstacles=marks, obstacle_inliers=int(np.count_nonzero(marked)))
    if not marked.any() or fit.alignment.inlier_count - fit.obstacle_inliers < min_inliers:
        return fit
    without = _without(fit, marked)
    if without is None or without.pose is None:
        return fit
    before, after = (
        dense.agreement(levels_a[0], levels_b[0], motion.matrix).correlation
        for motion in (pose, without.pose)
    )
    if not after > before:
        return fit
    correlation = local_correlation.local_correlation(first.view, second.view, without.pose.matrix)
    return replace(fit, alignment=without, correlation=correlation)


def _without(fit: PairFit, marked: BoolArray) -> FeatureAlignment | None:
    """Return the alignment by the inliers that are not marked."""
    alignment = fit.alignment
    assert alignment.pose is not None
    index_a, index_b = alignment.matches.T
    points_a = fit.first.points[index_a].astype(np.float64)
    points_b = fit.second.points[index_b].astype(np.float64)
    kept = alignment.inliers & ~marked
    refitted = align.fit_rigid(
        points_a[kept],
        points_b[kept],
        fit.first.sigmas[index_a[kept]].astype(np.float64),
        fit.second.sigmas[index_b[kept]].astype(np.float64),
        alignment.pose,
    )
    if refitted is None:
        return None
    return replace(
        alignment,
        a_from_b=refitted.a_from_b.matrix,
        pose=refitted.a_from_b,
        covariance=refitted.covariance,
        inliers=kept,
        residuals=np.linalg.norm(points_a - refitted.a_from_b.apply(points_b), axis=1),
    )


def _registered(
    levels_a: tuple[PyramidLevel, ...],
    levels_b: tuple[PyramidLevel, ...],
    pose: Pose2,
    calibration: Calibration,
) -> Float64Array:
    """Return (3, 3): how the views' floors lie best upon each other, the camera's rocking allowed.

    A tilt that differs between the frames, where it is not removed, would look like an obstacle.
    """
    best = pose.matrix
    highest = dense.agreement(levels_a[0], levels_b[0], best).correlation
    for times in _ROCKING_TIMES:
        tilt = math.radians(times * MapperOptions().tilt_sigma_degrees)
        refined = dense.refine(levels_a, levels_b, pose, calibration, tilt)
        if refined is None:
            continue
        warp = refined.view_a_from_view_b
        correlation = dense.agreement(levels_a[0], levels_b[0], warp).correlation
        if not correlation <= highest:
            best, highest, pose = warp, correlation, refined.a_from_b
    return best
