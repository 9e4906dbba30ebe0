"""Small records of registration made by hand: no images, every number as a test needs it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Pose2
from slamcli.core.records import (
    NO_PERIODS,
    FeatureAlignment,
    NormalisedDetail,
    PreparedFrame,
    PyramidLevel,
    Pyramids,
    Template,
)
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.stages import dense


def level_of(metres_per_pixel: float = 0.01, points: int = 4) -> PyramidLevel:
    byte, real = np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.float32)
    return PyramidLevel(
        pixel_from_metres=np.eye(3),
        metres_per_pixel=metres_per_pixel,
        image=byte,
        mask=byte,
        detail=real,
        inside=byte,
        weight=real,
        template=Deferred.of(Template(np.zeros((points, 2)), np.zeros((5, points)))),
        contrast=Deferred.of(NormalisedDetail(real, 0.0)),
        frame_noise_gray=0.0,
    )


def pair_of(*, far: bool = False) -> PyramidPair:
    """Return three levels of 1, 2 and 4 cm a pixel: one motion within 12 cm and 0.05 radians."""
    levels = tuple(level_of(metres_per_pixel) for metres_per_pixel in (0.01, 0.02, 0.04))
    return PyramidPair(levels, levels, far)


def frame_of(index: int = 0, repeats: Float64Array | None = None) -> PreparedFrame:
    levels = pair_of().a
    return PreparedFrame(
        index,
        f"frame {index}",
        None,
        None,
        None,
        pyramids=Deferred.of(Pyramids(levels)),
        periodicity=NO_PERIODS if repeats is None else Deferred.of(repeats),
    )


def fit_of(
    pose: Pose2 | None = None,
    *,
    correlation: float = 0.9,
    overlap: float = 0.8,
    confirmed: float = 0.9,
    normalised_correlation: float = 0.9,
    evidence: float = 100.0,
    sigmas: tuple[float, float, float] = (0.001, 0.001, 0.001),
    **others: Any,
) -> MotionHypothesis:
    """Return a fit that passes every gate, but for what is given."""
    pose = Pose2(0.05) if pose is None else pose
    return MotionHypothesis(
        pose,
        np.diag(np.square(sigmas)),
        np.diag(np.square(sigmas)),
        dense.Agreement(correlation, overlap, confirmed),
        evidence,
        normalised_correlation,
        others.pop("view_a_from_view_b", pose.matrix),
        **others,
    )


def alignment_of(inliers: int, pose: Pose2 | None = None, reason: str = "") -> FeatureAlignment:
    return FeatureAlignment(
        "rigid",
        None if pose is None else pose.matrix,
        pose,
        None if pose is None else np.eye(3) * 1e-6,
        np.zeros((inliers, 2), np.int32),
        np.ones(inliers, np.bool_),
        np.full(inliers, math.nan),
        1.0,
        reason,
    )
