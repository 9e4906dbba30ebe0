"""The covariance of a fit in which few blocks of the view determine a direction."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.stages.dense import covariance
from slamcli.stages.dense.covariance import FitState, NormalEquations
from slamcli.stages.dense.pyramid import Places

# Blocks along a line, whose ends alone determine the motion along it.
BLOCKS, POINTS = 30, 40
DEVIATION = 0.5


def score_covariance(generator: np.random.Generator) -> tuple[float, float]:
    """Return the error along the line of a fit, and its variance by the blocks' residuals.

    The residuals of an end share one error, as its blur has.
    """
    block = np.repeat(np.arange(BLOCKS), POINTS)
    slopes = np.zeros((2, len(block)))
    slopes[0] = 1.0
    slopes[1, (block == 0) | (block == BLOCKS - 1)] = 1.0
    residual = generator.normal(0.0, DEVIATION, BLOCKS)[block]
    weight = np.ones(len(block))
    information = slopes @ slopes.T
    step = np.linalg.solve(information, slopes @ residual)
    left = residual - step @ slopes
    solved = NormalEquations(
        FitState(Pose2(), np.zeros(0), np.zeros(0)),
        slopes,
        Places(np.zeros((2, 1, 1), np.float32), np.arange(len(block))),
        np.zeros((len(block), 2)),
        left,
        weight,
        np.zeros((2, 2)),
    )
    scores = covariance._score_covariance(block, solved, information)
    inverse = np.linalg.inv(information)
    variances: Float64Array = np.diag(inverse @ scores @ inverse)
    return float(step[1]), float(variances[1])


def test_a_direction_that_two_blocks_determine_is_as_uncertain_as_it_is() -> None:
    """By the residuals as they are, the variance would be half of what the errors show."""
    generator = np.random.default_rng(0)
    errors, variances = np.array([score_covariance(generator) for _ in range(400)]).T
    assert 0.8 < np.mean(variances) / np.mean(errors**2) < 2.0
