"""Robust statistics and the closed-form rigid fit: on data whose answer is known."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from slamcli.core import robust
from slamcli.core.geometry import Pose2

# Normal errors, at their quantiles instead of drawn.
NORMAL = ndtri((np.arange(100_000) + 0.5) / 100_000)


def test_the_constants_are_those_of_normal_errors() -> None:
    deviation = float(np.median(np.abs(NORMAL)))
    assert math.isclose(deviation, robust.NORMAL_MEDIAN, rel_tol=1e-4)
    assert math.isclose(robust.SIGMA_PER_MAD * deviation, 1.0, rel_tol=1e-4)
    assert math.isclose(1.0 - math.exp(-(robust.RAYLEIGH_MEDIAN**2) / 2.0), 0.5)


def test_the_kernel_keeps_small_residuals_and_all_but_ignores_outliers() -> None:
    sigmas = np.array([0.0, 1.0, 5.0])
    weights = robust.geman_mcclure_weights((sigmas / robust.GEMAN_MCCLURE_SIGMAS) ** 2)
    assert weights[0] == 1.0
    assert weights[1] > 0.8
    assert weights[2] < 0.08


def test_the_kernel_costs_a_tenth_of_the_efficiency_of_least_squares() -> None:
    # Of the M-estimate of a mean: E[psi']^2 / E[psi^2] (Huber, Robust Statistics, 3.2).
    squared = (NORMAL / robust.GEMAN_MCCLURE_SIGMAS) ** 2
    weights = robust.geman_mcclure_weights(squared)
    slope = np.mean(weights - 4.0 * squared * (1.0 + squared) ** -3)
    assert 0.90 < slope**2 / np.mean((weights * NORMAL) ** 2) < 0.92


def test_a_rigid_fit_finds_the_motion_and_never_mirrors() -> None:
    truth = Pose2(0.3, -1.2, 2.5)
    b = np.random.default_rng(3).uniform(-1.0, 1.0, (20, 2))
    fit = robust.fit_rigid_2d(truth.apply(b), b)
    np.testing.assert_allclose(fit.matrix, truth.matrix, atol=1e-12)
    mirrored = robust.fit_rigid_2d(b * (1.0, -1.0), b)
    assert math.isclose(np.linalg.det(mirrored.matrix), 1.0)


def test_a_rigid_fit_follows_its_weights() -> None:
    truth = Pose2(0.3, -1.2, 2.5)
    b = np.random.default_rng(4).uniform(-1.0, 1.0, (20, 2))
    a = truth.apply(b)
    a[0] += 5.0
    weights = np.ones(20)
    weights[0] = 0.0
    np.testing.assert_allclose(robust.fit_rigid_2d(a, b, weights).matrix, truth.matrix, atol=1e-12)
    assert abs(robust.fit_rigid_2d(a, b).x - truth.x) > 0.1
