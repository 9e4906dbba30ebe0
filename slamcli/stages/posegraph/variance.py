"""A posteriori variance factor: the links' real errors relative to their covariances.

A link's covariance is estimated from two pictures, and does not cover what these do not show. A
graph with loops measures it once more, by the variance of its residuals (the a posteriori variance
factor of geodesy: Mikhail and Ackermann, Observations and Least Squares, 1976).
"""

from __future__ import annotations

from slamcli.core.arrays import Float64Array

# Prior weight of the links' own covariances, as a number of residuals.
# [guarded by tests/stages/test_posegraph.py: test_how_links_agree_corrects_what_they_claim]
_PRIOR_RESIDUALS = 10.0
_FREEDOM = 3


def variance_factor(squared_errors: Float64Array, surplus_links: int, closed_loops: int) -> float:
    """Return the factor by which the links' covariances are to be multiplied.

    Residuals above expectation raise it at once. Residuals below lower it only as far as loops
    close: links of one stretch share frames, and may share an error, such as a calibration's, that
    no residual among them shows.

    Parameters
    ----------
    squared_errors : (L,) float64
        Each link's squared residual in its own variances, at the solution.
    surplus_links : int
        Number of links beyond a spanning tree of the poses.
    closed_loops : int
        Number of links between frames that are not of one stretch.
    """
    if surplus_links <= 0:
        return 1.0
    residuals = float(_FREEDOM * surplus_links)
    total = float(squared_errors.sum())
    if total < residuals:
        closed = min(1.0, closed_loops / surplus_links)
        total, residuals = closed * total, closed * residuals
    return (_PRIOR_RESIDUALS + total) / (_PRIOR_RESIDUALS + residuals)
