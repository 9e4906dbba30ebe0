"""Error of scale that all poses have in common: the calibration's, which no link shows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from slamcli.core.records import PoseEstimate


def with_scale_error(estimates: Iterable[PoseEstimate], scale_sigma: float) -> list[PoseEstimate]:
    """Return estimates whose covariances have the uncertainty of the map's scale in them.

    A map that is too large by a share puts a pose off by that share of its distance from the
    fragment's first frame, where the map begins.

    Parameters
    ----------
    estimates : iterable of PoseEstimate
        Their covariances are those of the links and readings.
    scale_sigma : float
        One standard deviation of the share; nan where it is not known.
    """
    known = list(estimates)
    if not scale_sigma > 0.0:
        return known
    origins: dict[int, tuple[float, float]] = {}
    result = []
    for estimate in known:
        pose, covariance = estimate.map_from_robot, estimate.covariance
        if pose is None or covariance is None:
            result.append(estimate)
            continue
        x, y = origins.setdefault(estimate.fragment, (pose.x, pose.y))
        cosine, sine = math.cos(pose.theta), math.sin(pose.theta)
        ahead, left = pose.x - x, pose.y - y
        # Like the covariance, in the robot's own axes.
        lever = scale_sigma * np.array(
            [cosine * ahead + sine * left, cosine * left - sine * ahead, 0.0]
        )
        result.append(replace(estimate, covariance=covariance + np.outer(lever, lever)))
    return result
