"""Keypoints and features of a view, and the alignment of two sets of features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, Int32Array, UInt8Array
from slamcli.core.config import TransformModel
from slamcli.core.geometry import Pose2

DescriptorNorm = Literal["hamming", "hamming2", "l2"]


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of a view with their descriptors, in pixels: for drawings, and to make Features of.

    Attributes
    ----------
    pixels : (N, 2) float64
        Column and row in the view.
    sizes : (N,) float32, pixels
        Diameter of what the descriptor is centred on.
    angles : (N,) float32, degrees
        Clockwise in the picture, in [0, 360); nan where the descriptor does not turn.
    responses : (N,) float32
    octaves : (N,) int32
        Pyramid level; 0 is the view itself.
    scales : (N,) float32
        Pixels of the view to a pixel of the pyramid level.
    sigmas : (N,) float32, pixels
        One standard deviation of the position, in the view.
    descriptors : (N, D) uint8 or float32
    norm : str
        How descriptors are compared.
    """

    pixels: Float64Array
    sizes: Float32Array
    angles: Float32Array
    responses: Float32Array
    octaves: Int32Array
    scales: Float32Array
    sigmas: Float32Array
    descriptors: UInt8Array | Float32Array
    norm: DescriptorNorm

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Points of the floor with their descriptors, in metres: what matching and alignment use.

    Attributes
    ----------
    points : (N, 2) float32, metres, robot frame
    descriptors : (N, D) uint8 (compare by Hamming distance) or float32 (by L2)
    scores : (N,) float32
        The detector's response: larger is stronger.
    sigmas : (N, 2) float32, metres
        One standard deviation along the line of sight on the floor, and across it.
    sizes : (N,) float32, metres
        Diameter of what the descriptor is centred on.
    angles : (N,) float32, radians
        Orientation of its surroundings, counter-clockwise from the robot's x; nan where the
        descriptor does not turn with them.
    norm : str
        How descriptors are compared; ``hamming2`` counts pairs of bits (ORB with WTA_K 3 or 4).
    """

    points: Float32Array
    descriptors: UInt8Array | Float32Array
    scores: Float32Array
    sigmas: Float32Array
    sizes: Float32Array
    angles: Float32Array
    norm: DescriptorNorm = "hamming"

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True, eq=False)
class FeatureAlignment:
    """A transform fitted to the matches of two sets of features, or why it is not accepted.

    Attributes
    ----------
    model : str
    a_from_b : (3, 3) float64 or None
        Metres to metres; None when nothing at all could be fitted.
    pose : Pose2 or None
        The same when the model is rigid.
    covariance : (3, 3) float64 or None
        Of `pose`: x, y (m) and theta (rad), in b's own axes (GTSAM's tangent space).
    matches : (M, 2) int32
        Indices into a's and b's features.
    inliers : (M,) bool
    residuals : (M,) float64, metres
        Of all matches; nan without a fit.
    spread : float
        Of the inliers over the view: their narrower extent over that of all its points.
    reason : str
        Why the transform is not accepted; empty when it is.
    """

    model: TransformModel
    a_from_b: Float64Array | None
    pose: Pose2 | None
    covariance: Float64Array | None
    matches: Int32Array
    inliers: BoolArray
    residuals: Float64Array
    spread: float
    reason: str = ""

    @property
    def accepted(self) -> bool:
        """Whether the transform passed every gate."""
        return not self.reason

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with the transform."""
        return int(self.inliers.sum())

    @property
    def median_residual(self) -> float:
        """Of the inliers, in metres; nan without any."""
        return float(np.median(self.residuals[self.inliers])) if self.inliers.any() else np.nan

    @property
    def rms_residual(self) -> float:
        """Root mean square over the inliers, in metres; nan without any."""
        if not self.inliers.any():
            return np.nan
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))
