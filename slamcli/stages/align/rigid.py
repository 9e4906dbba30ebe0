"""The rigid motion of a link, weighted by how well each point is known, with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from slamcli.core.geometry import Pose2
from slamcli.stages import camera

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_ITERATIONS = 20
_CONVERGED_SIGMAS = 1e-4
# Geman and McClure's scale in sigmas: keeps 97 % of the efficiency of least squares on normal
# errors, and all but ignores what is five sigmas off.
_KERNEL_SIGMAS = 3.0
# Two coordinates of a normal error: the median of its length in sigmas.
_RAYLEIGH_MEDIAN = math.sqrt(2.0 * math.log(2.0))
# The sigmas given are believed as much as this many residuals are: few points, or the same
# picture twice, cannot make a motion look perfectly known.
_PRIOR_RESIDUALS = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """A rigid motion with its covariance.

    Attributes
    ----------
    a_from_b : Pose2
    covariance : (3, 3) float64
        Of x, y (m) and theta (rad), in b's own axes: of xi in ``a_from_b @ exp(xi)``.
    weights : (M,) float64
        From 1, a point that fits, to 0, one that is ignored.
    scale : float
        How many times larger the residuals are than the sigmas said.
    """

    a_from_b: Pose2
    covariance: NDArray[np.float64]
    weights: NDArray[np.float64]
    scale: float


def fit_rigid(
    points_a: NDArray[np.float64],
    points_b: NDArray[np.float64],
    sigmas_a: NDArray[np.float64],
    sigmas_b: NDArray[np.float64],
    guess: Pose2,
) -> RigidFit | None:
    """Refine a rigid motion by robust, weighted least squares (Gauss-Newton).

    The residual of a match has the covariance ``S_a + R S_b R^T``, each S in the axes of its
    point's line of sight; outliers are weighted down by Geman and McClure's kernel.

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
    for _ in range(_MOST_ITERATIONS):
        residual, jacobian = _whitened(points_a, points_b, covariance_a, covariance_b, pose)
        length = np.linalg.norm(residual, axis=1)
        scale = _scale(length)
        weights = _kernel(length / scale)
        weighted = jacobian * weights[:, None, None]
        information = np.einsum("nij,nik->jk", weighted, jacobian)
        try:
            step = -np.linalg.solve(information, np.einsum("nij,ni->j", weighted, residual))
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


def _covariances(points: NDArray[np.float64], sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (M, 2, 2) covariances in the robot frame from sigmas along and across the sight."""
    axes = np.stack(camera.line_of_sight_axes(points), axis=2)
    return np.asarray((axes * sigmas[:, None, :] ** 2) @ axes.transpose(0, 2, 1))


def _whitened(
    points_a: NDArray[np.float64],
    points_b: NDArray[np.float64],
    covariance_a: NDArray[np.float64],
    covariance_b: NDArray[np.float64],
    pose: Pose2,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return residuals (M, 2) in sigmas and their Jacobian (M, 2, 3) by a motion in b's axes."""
    rotation = pose.matrix[:2, :2]
    residual = points_a - pose.apply(points_b)
    jacobian = np.empty((len(points_a), 2, 3))
    jacobian[:, :, :2] = -rotation
    jacobian[:, :, 2] = -np.column_stack([-points_b[:, 1], points_b[:, 0]]) @ rotation.T
    total = covariance_a + rotation @ covariance_b @ rotation.T
    # The inverse of each 2x2 Cholesky factor, written out.
    first = np.sqrt(total[:, 0, 0])
    below = total[:, 1, 0] / first
    second = np.sqrt(total[:, 1, 1] - below**2)
    whitening = np.zeros_like(total)
    whitening[:, 0, 0] = 1.0 / first
    whitening[:, 1, 0] = -below / (first * second)
    whitening[:, 1, 1] = 1.0 / second
    return np.einsum("nij,nj->ni", whitening, residual), whitening @ jacobian


def _kernel(length: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return Geman and McClure's weights of residual lengths in sigmas."""
    weights: NDArray[np.float64] = (1.0 + (length / _KERNEL_SIGMAS) ** 2) ** -2
    return weights


def _scale(length: NDArray[np.float64]) -> float:
    """Return how many times larger residuals are than their sigmas said, by their median."""
    count = len(length)
    measured = (float(np.median(length)) / _RAYLEIGH_MEDIAN) ** 2
    # Three of the 2 M residuals' degrees of freedom went into the motion.
    measured *= 2.0 * count / max(2.0 * count - 3.0, 1.0)
    return math.sqrt((_PRIOR_RESIDUALS + count * measured) / (_PRIOR_RESIDUALS + count))


def _covariance_of_estimate(
    length: NDArray[np.float64], jacobian: NDArray[np.float64], scale: float
) -> NDArray[np.float64] | None:
    """Return the covariance of an M-estimate (Huber, Robust Statistics, 7.6).

    ``E[psi^2] / E[psi']^2`` times the covariance of least squares, with psi the weighted residual,
    both expectations taken over its two coordinates.
    """
    information = np.einsum("nij,nik->jk", jacobian, jacobian) / scale**2
    weights = _kernel(length)
    squared = (length / _KERNEL_SIGMAS) ** 2
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
    return np.asarray((covariance + covariance.T) / 2.0)
