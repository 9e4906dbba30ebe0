"""A motion that views leave open in one direction, as along a plain line, where it is expected.

All motions along the line fit alike, and a refinement stops anywhere among them: decimetres from
where the robot is. There its covariance says how the turn and the motion across change along the
line, by gradients that the camera's own pixels bend (aliasing). The prior chooses among motions
that fit alike; what the pixels determine beside it is then measured there.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.registration import hypotheses
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair, score_refined
from slamcli.stages import dense

# While the rest is refined, the motion along the open direction is fixed to this, in pixels of the
# finest level, and the rest is free up to this, metres and radians
# [guarded by benchmarks/courses.py: layouts 6 and 8 with odometry].
_FIXED_PIXELS = 0.1
_FREE = 1.0


def where_expected(
    pair: PyramidPair,
    fit: MotionHypothesis,
    prior: dense.MotionPrior,
    calibration: Calibration,
    options: MapperOptions,
) -> MotionHypothesis:
    """Return an open motion at the place along its open direction that a prior expects.

    The fit itself where the pixels differ there. Its covariance stays that of the pixels alone.

    Parameters
    ----------
    pair : PyramidPair
    fit : MotionHypothesis
        Open along the least certain direction of its translation.
    prior : MotionPrior
    calibration : Calibration
    options : MapperOptions
    """
    variances, directions = np.linalg.eigh(fit.predicted_covariance[:2, :2])
    along = directions[:, 1]
    apart = fit.pose.inverse() @ prior.a_from_b
    # As far as the fit, with its own uncertainty, leaves the choice to the prior.
    share = variances[1] / (variances[1] + along @ prior.covariance[:2, :2] @ along)
    x, y = along * (along @ (apart.x, apart.y)) * share
    start = fit.pose @ Pose2(float(x), float(y))
    fixed = np.diag([_FREE**2] * 3)
    sigma = _FIXED_PIXELS * pair.a[0].metres_per_pixel
    fixed[:2, :2] += (sigma**2 - _FREE**2) * np.outer(along, along)
    # A little tilt shifts what lies far off by much: it is never refined without.
    rocks = pair.far or fit.includes_rocking
    refined = dense.refine(
        pair.a[:2],
        pair.b[:2],
        start,
        calibration,
        math.radians(options.tilt_sigma_degrees) if rocks else 0.0,
        dense.RefinementAssumptions(prior=dense.MotionPrior(start, fixed)),
    )
    if refined is None:
        return fit
    moved = score_refined(pair, refined)
    if hypotheses.outside_open_direction([moved], fit):
        return fit
    return replace(moved, covariance=fit.covariance, predicted_covariance=fit.predicted_covariance)
