"""The ground below a survey: a similarity from its map to metres east and north, by GPS places.

A survey without a calibration has a unit of its own. Where its photos were taken gives scale,
direction and place; consumer receivers err by metres, alike for photos that follow one another, so
nothing finer than their sigma is concluded from how well the places agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slamcli.core.arrays import BoolArray, Complex128Array, Float64Array
from slamcli.core.camera.calibration import Rocking
from slamcli.core.geometry import Pose2
from slamcli.core.robust import RAYLEIGH_MEDIAN

# A place is an outlier farther away than so many sigmas.
_OUTLIER_SIGMAS = 4.0
_MIN_PLACES, _MIN_INLIER_SHARE = 3, 0.5
# A scale that is known worse is none. [guarded by tests/run/stitch/test_photos.py]
_MAX_SCALE_SIGMA_SHARE = 0.1
# Pairs of places that are tried, the ones farthest apart.
_MAX_PAIRS, _ROUNDS = 2000, 5


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Where a map lies.

    Attributes
    ----------
    metres_per_unit : float
        Of the map's unit.
    east_north_from_map : Pose2
        Of the map in metres.
    covariance : (3, 3) float64
        Of that: x, y (m) and theta (rad), east and north.
    scale_sigma_share : float
        One standard deviation of the scale, as a share of it.
    inliers : (N,) bool
        The places that agree.
    """

    metres_per_unit: float
    east_north_from_map: Pose2
    covariance: Float64Array
    scale_sigma_share: float
    inliers: BoolArray


def below_camera(pose: Pose2, rocking: Rocking, focal_pixels: float) -> tuple[float, float]:
    """Return the point of the map straight below a camera of a survey, in the map's unit.

    The pose is of the floor in the picture's middle: see `top_down_homography`.
    """
    away = focal_pixels + rocking.height_metres
    # The third row of the rotation, which is what the camera sees of the vertical.
    ahead = away * np.array(
        [np.sin(rocking.roll_radians), np.cos(rocking.roll_radians) * np.sin(rocking.pitch_radians)]
    )
    x, y = pose.apply(ahead[None])[0].tolist()
    return float(x), float(y)


def fit_ground(
    points: Float64Array, east_north: Float64Array, sigmas: Float64Array
) -> Ground | None:
    """Return the similarity that most places agree with; None when they do not determine it.

    Parameters
    ----------
    points : (N, 2) float64
        In the map's unit.
    east_north : (N, 2) float64
        Metres.
    sigmas : (N,) float64
        One standard deviation of each place, metres, east and north alike.
    """
    if len(points) < _MIN_PLACES:
        return None
    z, w = points @ np.array([1.0, 1.0j]), east_north @ np.array([1.0, 1.0j])
    factor, shift = _consensus(z, w, sigmas)
    # The map errs, too: what most places differ by is no outlier.
    ratios = np.abs(factor * z + shift - w) / sigmas
    sigmas = sigmas * max(1.0, float(np.median(ratios)) / RAYLEIGH_MEDIAN)
    inliers = np.ones(len(points), np.bool_)
    for _ in range(_ROUNDS):
        spread = sigmas if inliers.all() else _spread(z, sigmas, inliers)
        inliers = np.abs(factor * z + shift - w) <= _OUTLIER_SIGMAS * spread
        if inliers.sum() < max(_MIN_PLACES, _MIN_INLIER_SHARE * len(points)):
            return None
        factor, shift = _fit(z[inliers], w[inliers], sigmas[inliers])
    return _ground(z, sigmas, inliers, factor, shift)


def _consensus(
    z: Complex128Array, w: Complex128Array, sigmas: Float64Array
) -> tuple[complex, complex]:
    """Return the similarity through two places that the others agree with best."""
    pairs = sorted(combinations(range(len(z)), 2), key=lambda pair: -abs(z[pair[0]] - z[pair[1]]))
    best, best_cost = (0j, 0j), np.inf
    for a, b in pairs[:_MAX_PAIRS]:
        if z[a] == z[b]:
            break
        factor = (w[a] - w[b]) / (z[a] - z[b])
        ratios = np.abs(factor * (z - z[a]) + w[a] - w) / sigmas
        cost = float(np.minimum(ratios, _OUTLIER_SIGMAS).sum())
        if cost < best_cost:
            best, best_cost = (complex(factor), complex(w[a] - factor * z[a])), cost
    return best


def _fit(z: Complex128Array, w: Complex128Array, sigmas: Float64Array) -> tuple[complex, complex]:
    """Return factor and shift of the similarity of least squares (Umeyama, PAMI 13, 1991)."""
    weights = sigmas**-2
    from_z, from_w = np.average(z, weights=weights), np.average(w, weights=weights)
    spread = np.sum(weights * np.abs(z - from_z) ** 2)
    factor = complex(np.sum(weights * np.conj(z - from_z) * (w - from_w)) / spread)
    return factor, complex(from_w - factor * from_z)


def _spread(z: Complex128Array, sigmas: Float64Array, inliers: BoolArray) -> Float64Array:
    """Return (N,) sigmas of the residuals: of a place that is left out also the fit's own."""
    weights = sigmas[inliers] ** -2
    away = np.abs(z - np.average(z[inliers], weights=weights)) ** 2
    fitted = 1.0 / weights.sum() + away / (weights @ away[inliers])
    return np.asarray(np.sqrt(sigmas**2 + np.where(inliers, 0.0, fitted)), np.float64)


def _ground(
    z: Complex128Array, sigmas: Float64Array, inliers: BoolArray, factor: complex, shift: complex
) -> Ground | None:
    weights = sigmas[inliers] ** -2
    centre = complex(np.average(z[inliers], weights=weights))
    information = float(np.sum(weights * np.abs(factor * (z[inliers] - centre)) ** 2))
    # Of a turn and of the logarithm of the scale alike.
    variance = 1.0 / information if information > 0.0 else np.inf
    if not variance <= _MAX_SCALE_SIGMA_SHARE**2:
        return None
    # The origin turns, and is stretched, about the middle of the places.
    arm = factor * -centre
    place = 1.0 / float(np.sum(weights)) + variance * abs(arm) ** 2
    covariance = np.diag([place, place, variance])
    covariance[:2, 2] = covariance[2, :2] = variance * np.array([-arm.imag, arm.real])
    heading = float(np.angle(factor))
    pose = Pose2(shift.real, shift.imag, heading)
    return Ground(abs(factor), pose, covariance, float(np.sqrt(variance)), inliers)
