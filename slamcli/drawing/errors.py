"""Plots of trajectories' errors along the path, as vector graphics or pictures, by matplotlib."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.errors import InputError
from slamcli.core.trajectory import ErrorSeries

SUFFIXES = (".pdf", ".svg", ".png")
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_DOTS_PER_INCH = 150
# A trajectory of as many poses has a mark at each.
_MAX_MARKED = 60


def check_plots() -> None:
    """Raise InputError when the library that draws plots is not installed."""
    _figure()


def plot_errors(series: Sequence[ErrorSeries], truth: Float64Array, suffix: str) -> bytes:
    """Return a figure: the paths beside the true one, and each error with its sigma envelope.

    Parameters
    ----------
    series : sequence of ErrorSeries
    truth : (N, 2) float64
        The true path, metres.
    suffix : str
        One of `SUFFIXES`; the same bytes for the same numbers.

    Raises
    ------
    InputError
        When matplotlib is not installed.
    """
    figure = _figure()(figsize=(7.0, 6.4), layout="constrained")
    way, error, heading = figure.subplot_mosaic(
        [["way", "way"], ["error", "heading"]], height_ratios=[1.35, 1.0]
    ).values()
    way.plot(truth[:, 0], truth[:, 1], color="0.75", linewidth=4.0, label="truth")
    for number, one in enumerate(series):
        colour = _COLOURS[number % len(_COLOURS)]
        marker = "." if len(one.errors_metres) <= _MAX_MARKED else ""
        # A line has gaps between fragments, which are aligned each for itself.
        gaps = np.flatnonzero(np.diff(one.fragments)) + 1
        x, y = (np.insert(column, gaps, np.nan) for column in one.aligned.T)
        along, errors, turns, bound = (
            np.insert(values, gaps, np.nan)
            for values in (
                one.path_metres,
                1000.0 * one.errors_metres,
                one.errors_degrees,
                2000.0 * one.sigmas_metres,
            )
        )
        style = {"color": colour, "linewidth": 1.0, "marker": marker, "markersize": 3.0}
        way.plot(x, y, label=one.name, **style)
        error.plot(along, errors, **style)
        heading.plot(along, turns, **style)
        if np.isfinite(bound).any():
            error.fill_between(along, 0.0, bound, color=colour, alpha=0.15, linewidth=0.0)
    way.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", adjustable="datalim")
    way.legend(fontsize="small")
    shade = " (shaded: 2 sigma)" if any(np.isfinite(s.sigmas_metres).any() for s in series) else ""
    error.set(xlabel="along the path (m)", ylabel="position error (mm)", ylim=(0.0, None))
    error.set_title(f"ATE{shade}", fontsize="small")
    heading.set(xlabel="along the path (m)", ylabel="heading error (°)", ylim=(0.0, None))
    for axes in (way, error, heading):
        axes.grid(linewidth=0.3)
    stream = io.BytesIO()
    # Neither the time nor the library's version is part of the figure.
    nothing = {".pdf": ("CreationDate", "Producer", "Creator"), ".svg": ("Date", "Creator")}
    metadata: dict[str, Any] = dict.fromkeys(nothing.get(suffix, ("Software",)))
    figure.savefig(stream, format=suffix[1:], dpi=_DOTS_PER_INCH, metadata=metadata)
    return stream.getvalue()


def _figure() -> Any:
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(
            "plots need matplotlib; install it with: pip install slamcli[plot]"
        ) from error
    # Names of elements in an SVG are random otherwise.
    mpl.rcParams["svg.hashsalt"] = "slamcli"
    return Figure
