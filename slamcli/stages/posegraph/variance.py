"""How well links agree, beside what each says of its own error.

A link's covariance is told from two pictures, and guards against what these may hide: on clear
floor it is several times too wide. A graph with loops measures the same thing once more: its
residuals' variance, for links of unit weight (the a posteriori variance factor of geodesy: Mikhail
and Ackermann, Observations and Least Squares, 1976).
"""

from __future__ import annotations

from slamcli.core.arrays import Float64Array

# What links say of their own errors weighs as much as so many residuals.
_TOLD_BY_THEMSELVES = 10.0
_FREEDOM = 3


def variance_factor(squared_errors: Float64Array, surplus_links: int, closed_loops: int) -> float:
    """Return what the links' covariances are to be multiplied by.

    That links contradict one another shows at once that they err by more than they say. That they
    agree shows the opposite only as far as loops close: those of one stretch share frames, and so
    may share an error, such as a calibration's, which none of them shows.

    Parameters
    ----------
    squared_errors : (L,) float64
        Each link's squared residual in its own variances, at the solution.
    surplus_links : int
        How many more there are than tie the poses together.
    closed_loops : int
        How many of the links are between frames that are not of one stretch.
    """
    if surplus_links <= 0:
        return 1.0
    residuals = float(_FREEDOM * surplus_links)
    total = float(squared_errors.sum())
    if total < residuals:
        shown = min(1.0, closed_loops / surplus_links)
        total, residuals = shown * total, shown * residuals
    return (_TOLD_BY_THEMSELVES + total) / (_TOLD_BY_THEMSELVES + residuals)
