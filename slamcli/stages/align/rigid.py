"""Rigid registration of point pairs by robust weighted least squares, with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.resolution import line_of_sight_axes
from slamcli.core.geometry import Pose2
from slamcli.core.robust import GEMAN_MCCLURE_SIGMAS, RAYLEIGH_MEDIAN, geman_mcclure_weights

_MAX_ITERATIONS = 20
# A step this small, in standard deviations of the motion, ends the iteration.
_CONVERGED_SIGMAS = 1e-3
# The sigmas given count as much as this many residuals do: few points, or the same picture twice,
# cannot make a motion look perfectly known [guarded by tests/stages/test_align.py].
_PRIOR_RESIDUALS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """Result of the rigid fit: a motion with its covariance.

    Attributes
    ----------
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m) and theta (rad), in b's own axes: of xi in ``a_from_b @ exp(xi)``.
    weights : (M,) float64
        From 1, a point that fits, to 0, one that is ignored.
    scale : float
        How many times larger the residuals are than the sigmas predict.
    """

    a_from_b: Pose2
    covariance: Float64Array
    weights: Float64Array
    scale: float


def fit_rigid(
    points_a: Float64Array,
    points_b: Float64Array,
    sigmas_a: Float64Array,
    sigmas_b: Float64Array,
    guess: Pose2,
) -> RigidFit | None:
    """Refine a rigid motion by robust, weighted least squares (Gauss-Newton).

    The residual of a match has the covariance ``S_a + R S_b R^T``, each S in the axes of its
    point's line of sight; outliers are down-weighted by Geman and McClure's kernel.

    Parameters
    ----------
    points_a, points_b : (M, 2) float64, metres, each in its robot frame
    sigmas_a, sigmas_b : (M, 2) float64, metres
        Along and across the line of sight.
    guess : Pose2
        ``a_from_b`` within the residuals' size, as RANSAC leaves it.

    Returns
    -------
    RigidFit or None
        None when the points do not determine a motion.
    """
    covariance_a = _covariances(points_a, sigmas_a)
    covariance_b = _covariances(points_b, sigmas_b)
    pose = guess
    for _ in range(_MAX_ITERATIONS):
        residual, jacobian = _whitened(points_a, points_b, covariance_a, covariance_b, pose)
        length = np.hypot(*residual)
        scale = _scale(length)
        weights = geman_mcclure_weights((length / scale / GEMAN_MCCLURE_SIGMAS) ** 2)
        weighted = jacobian * weights
        information = _products(weighted, jacobian)
        try:
            step = -np.linalg.solve(information, np.einsum("kin,in->k", weighted, residual))
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        pose = pose @ Pose2(float(step[0]), float(step[1]), float(step[2]))
        if step @ information @ step < (_CONVERGED_SIGMAS * scale) ** 2:
            break
    covariance = _covariance_of_estimate(length / scale, jacobian, scale)
    if covariance is None:
        return None
    return RigidFit(pose, covariance, weights, scale)


def _covariances(points: Float64Array, sigmas: Float64Array) -> Float64Array:
    """Return (3, M) covariances xx, xy and yy in the robot frame, of sigmas in sight and across."""
    (sight_x, sight_y), (across_x, across_y) = (axis.T for axis in line_of_sight_axes(points))
    along, across = sigmas.T**2
    return np.stack(
        [
            along * sight_x**2 + across * across_x**2,
            along * sight_x * sight_y + across * across_x * across_y,
            along * sight_y**2 + across * across_y**2,
        ]
    )


def _whitened(
    points_a: Float64Array,
    points_b: Float64Array,
    covariance_a: Float64Array,
    covariance_b: Float64Array,
    pose: Pose2,
) -> tuple[Float64Array, Float64Array]:
    """Return residuals (2, M) in sigmas and their Jacobian (3, 2, M) by a motion in b's axes."""
    cosine, sine = math.cos(pose.theta), math.sin(pose.theta)
    residual_x, residual_y = (points_a - pose.apply(points_b)).T
    turned = _turning(cosine, sine) @ covariance_b
    total_xx, total_xy, total_yy = covariance_a + turned
    # The inverse of each 2x2 Cholesky factor, written out.
    first = 1.0 / np.sqrt(total_xx)
    second = 1.0 / np.sqrt(total_yy - (total_xy * first) ** 2)
    below = -total_xy * first**2 * second
    x, y = points_b.T
    residual = np.empty((2, len(x)))
    residual[0] = first * residual_x
    residual[1] = below * residual_x + second * residual_y
    # How x and y of the residual change with each part of the motion.
    by_x, by_y = (-cosine, -sine), (sine, -cosine)
    by_turn = (sine * x + cosine * y, sine * y - cosine * x)
    jacobian = np.empty((3, 2, len(x)))
    for row, (u, v) in zip(jacobian, (by_x, by_y, by_turn), strict=True):
        row[0] = first * u
        row[1] = below * u + second * v
    return residual, jacobian


def _turning(cosine: float, sine: float) -> Float64Array:
    """Return what turns covariances xx, xy and yy, as R S R^T does."""
    return np.array(
        [
            [cosine**2, -2.0 * cosine * sine, sine**2],
            [cosine * sine, cosine**2 - sine**2, -cosine * sine],
            [sine**2, 2.0 * cosine * sine, cosine**2],
        ]
    )


def _products(first: Float64Array, second: Float64Array) -> Float64Array:
    """Return (3, 3) sums over all residuals of products of two Jacobians' columns."""
    return first.reshape(3, -1) @ second.reshape(3, -1).T


def _scale(length: Float64Array) -> float:
    """Return how many times larger residuals are than their sigmas predict, by their median."""
    count = len(length)
    measured = (float(np.median(length)) / RAYLEIGH_MEDIAN) ** 2
    # Three of the 2 M residuals' degrees of freedom went into the motion.
    measured *= 2.0 * count / max(2.0 * count - 3.0, 1.0)
    return math.sqrt((_PRIOR_RESIDUALS + count * measured) / (_PRIOR_RESIDUALS + count))


def _covariance_of_estimate(
    length: Float64Array, jacobian: Float64Array, scale: float
) -> Float64Array | None:
    """Return the covariance of an M-estimate (Huber, Robust Statistics, 7.6).

    ``E[psi^2] / E[psi']^2`` times the covariance of least squares, with psi the weighted residual,
    both expectations taken over its two coordinates.
    """
    information = _products(jacobian, jacobian) / scale**2
    squared = (length / GEMAN_MCCLURE_SIGMAS) ** 2
    weights = geman_mcclure_weights(squared)
    psi_squared = float(np.mean((weights * length) ** 2)) / 2.0
    slope = float(np.mean(weights - 2.0 * squared * (1.0 + squared) ** -3))
    count = len(length)
    prior_weight = _PRIOR_RESIDUALS / (_PRIOR_RESIDUALS + count)
    inflation = prior_weight + (1.0 - prior_weight) * psi_squared / max(slope, 0.1) ** 2
    try:
        covariance = np.linalg.inv(information) * inflation
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(covariance).all() and np.all(np.diag(covariance) > 0.0)):
        return None
    return (covariance + covariance.T) / 2.0
