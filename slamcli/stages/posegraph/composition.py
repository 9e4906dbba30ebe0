"""Composition and fusion of relative poses with their covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Link

# Gauss-Newton converges quadratically: links of one pair of frames differ little.
_FUSE_STEPS = 4


def fuse(first: Link, second: Link) -> Link:
    """Return the least-squares estimate from two links between the same frames (Gauss-Newton).

    Of the first one's kind; each link counts in each direction by its information.
    """
    pose = first.a_from_b
    information = np.zeros((3, 3))
    for _ in range(_FUSE_STEPS):
        information, gradient = np.zeros((3, 3)), np.zeros(3)
        for link in (first, second):
            error = link.a_from_b.inverse() @ pose
            jacobian = Pose2(0.0, 0.0, error.theta).matrix
            weighted = jacobian.T @ np.linalg.inv(link.covariance)
            information += weighted @ jacobian
            gradient += weighted @ np.array([error.x, error.y, error.theta])
        step = -np.linalg.solve(information, gradient)
        pose = pose @ Pose2(float(step[0]), float(step[1]), float(step[2]))
    covariance = np.asarray(np.linalg.inv(information), np.float64)
    return replace(first, a_from_b=pose, covariance=covariance)


def compose_covariance(
    covariance_a: Float64Array, a_from_b: Pose2, covariance: Float64Array
) -> Float64Array:
    """Return the covariance of ``map_from_b`` from that of ``map_from_a`` and of ``a_from_b``.

    Each in the axes of its right-hand frame; the first is carried over by the adjoint of
    ``b_from_a`` (Sola, Deray and Atchuthan, A micro Lie theory, 2018, eq. 56).
    """
    inverse = a_from_b.inverse()
    adjoint = inverse.matrix
    adjoint[0, 2], adjoint[1, 2] = inverse.y, -inverse.x
    carried: Float64Array = adjoint @ covariance_a @ adjoint.T + covariance
    return carried
