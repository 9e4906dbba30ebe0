"""Line fits to the edge points of a side, with their covariance and how much the side bends."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.robust import SIGMA_PER_MAD
from slamcli.stages.square.candidates import line_through

# In sigmas: 95 % of the efficiency of least squares on normal errors.
_TUKEY_SIGMAS = 4.685
_MIN_SCALE_PIXELS = 0.03
_REWEIGHTINGS = 6
_RANSAC_DRAWS = 80
# Error of a whole side that its residuals do not show, one sigma at its middle and at either end
# [benchmarks/calibration_targets.py: NEES of the corners of 50 squares 0.80 at 0.005 and 0.36 at
# 0.02, where 1 is right].
_SYSTEMATIC_PIXELS = 0.005
_MAX_CORRELATED_PROFILES = 30
# One sigma of how a lens without calibration bends a line right across the picture, as a share
# of its width; the sagitta grows with the square of the length.
_USUAL_BOW = 0.0005
# A bow of fewer sigmas may be chance.
_CHANCE_SIGMAS = 3.0
# Variance of x^2's coefficient over N points spread evenly on [-1, 1], times N / variance.
_BOW_VARIANCE_FACTOR = 11.25


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A line fitted to a side: a point, unit direction and (2, 2) covariance of shift and slope.

    Its bow is the sagitta of a parabola over `half_length` to either side of the centre, positive
    inwards, shrunk towards zero by how much of it may be chance.
    """

    centre: Float64Array
    direction: Float64Array
    half_length: float
    covariance: Float64Array
    support: float
    bow_pixels: float
    residual_pixels: float
    blur_pixels: float = 0.0

    @property
    def line(self) -> Float64Array:
        """(3,) coefficients, the normal pointing out of the quadrilateral."""
        return line_through(self.centre, self.centre + self.direction)


def fit_side(
    points: Float64Array,
    weights: Float64Array,
    total: int,
    width_pixels: float,
) -> Side:
    """Fit one line by weighted total least squares, with the covariance of its place and slope.

    Parameters
    ----------
    points, weights : (N, 2) and (N,)
        Undistorted pixels.
    total : int
        Profiles that were read to get the points.
    width_pixels : float
        Of the picture, by which a usual lens bends a line of some length.
    """
    mass = float(weights.sum())
    centre, direction = _fit_line(points, weights)
    centred = points - centre
    along = centred @ direction
    across = centred @ np.array([direction[1], -direction[0]])
    variance = float(weights @ across**2) / mass
    moment = float(weights @ along**2)
    span = math.sqrt(max(moment / mass, 1e-12))
    correlated = _correlated_neighbours(across, weights)
    shift = variance * correlated / mass + _SYSTEMATIC_PIXELS**2
    slope = variance * correlated / moment + (_SYSTEMATIC_PIXELS / span) ** 2
    half_length = math.sqrt(3.0) * span
    bow, bow_sigma = _measure_bow(along / half_length, across, weights)
    # Shrunk towards straight, except for what a usual lens may bend and what cannot be chance.
    usual = _USUAL_BOW * (2.0 * half_length) ** 2 / width_pixels
    lens_gain = usual**2 / (usual**2 + bow_sigma**2 + 1e-12)
    certainty = 1.0 - (_CHANCE_SIGMAS * bow_sigma / bow) ** 2 if bow else 0.0
    bow *= max(lens_gain, certainty)
    return Side(
        centre=centre,
        direction=direction,
        half_length=half_length,
        covariance=np.diag([shift, slope]),
        support=float((weights > 0.2).sum()) / total,
        bow_pixels=bow,
        residual_pixels=math.sqrt(variance),
    )


def fit_side_robustly(points: Float64Array, total: int, width_pixels: float) -> Side:
    """Fit one line as `fit_side` does, with Tukey's weights."""
    weights = np.ones(len(points))
    for _ in range(_REWEIGHTINGS):
        centre, direction = _fit_line(points, weights)
        distance = (points - centre) @ np.array([direction[1], -direction[0]])
        scale = max(SIGMA_PER_MAD * float(np.median(np.abs(distance))), _MIN_SCALE_PIXELS)
        weights = np.clip(1.0 - (distance / (_TUKEY_SIGMAS * scale)) ** 2, 0.0, None) ** 2
    return fit_side(points, weights, total, width_pixels)


def _fit_line(points: Float64Array, weights: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return a point of the line and its unit direction, from the first point to the last."""
    centre = weights @ points / float(weights.sum())
    x, y = (points - centre).T
    # The principal axis of a plane scatter in closed form.
    angle = 0.5 * math.atan2(2.0 * float(weights @ (x * y)), float(weights @ (x * x - y * y)))
    direction = np.array([math.cos(angle), math.sin(angle)])
    heading = float(direction @ (points[-1] - points[0]))
    return centre, direction if heading > 0 else -direction


def ransac_weights(points: Float64Array) -> Float64Array:
    """Return (N,) 1 for the points on the line through two of them that most agree with, else 0."""
    generator = np.random.default_rng(len(points))
    first = generator.integers(len(points), size=_RANSAC_DRAWS)
    second = (first + generator.integers(1, len(points), size=_RANSAC_DRAWS)) % len(points)
    lines = line_through(points[first], points[second])
    distance = np.abs(points @ lines[:, :2].T + lines[:, 2])
    # A truncated quadratic, between counting and least squares (MSAC).
    cost = np.minimum(distance**2, 1.0).sum(axis=0)
    weights: Float64Array = (distance[:, int(cost.argmin())] < 1.5).astype(np.float64)
    return weights


def _measure_bow(
    places: Float64Array, across: Float64Array, weights: Float64Array
) -> tuple[float, float]:
    """Return the sagitta, pixels, of a parabola over `places` in [-1, 1], and its sigma."""
    fit = np.polynomial.polynomial.polyfit(places, across, 2, w=np.sqrt(weights))
    left = across - np.polynomial.polynomial.polyval(places, fit)
    mass = float(weights.sum())
    variance = float(weights @ left**2) / mass * _correlated_neighbours(left, weights)
    return float(fit[2]), math.sqrt(_BOW_VARIANCE_FACTOR * variance / mass)


def _correlated_neighbours(residuals: Float64Array, weights: Float64Array) -> float:
    """Return how many neighbouring profiles err as one: shared pixels, and grain of the floor.

    The integrated autocorrelation 1 + 2 sum rho_k, cut at its first lag without correlation.
    """
    weighted = residuals * weights
    power = float(weighted @ weighted)
    total = 1.0
    for lag in range(1, min(_MAX_CORRELATED_PROFILES, len(residuals) // 3)):
        correlation = float(weighted[lag:] @ weighted[:-lag]) / max(power, 1e-12)
        if correlation <= 0.0:
            break
        total += 2.0 * correlation
    return total
