"""How points of two frames are paired, and what they must agree on."""

from __future__ import annotations

import click

from slamcli.cli.options.common import seed, stacked
from slamcli.cli.options.values import PATH, POSITIVE
from slamcli.core.config import MatchOptions

_MATCHING = MatchOptions()

match_details = stacked(
    click.option(
        "--matcher",
        type=click.Choice(["nearest", "lightglue"]),
        default="nearest",
        show_default=True,
        help="Pair points by the nearest descriptors, or ALIKED's and DISK's by LightGlue.",
    ),
    click.option(
        "--matcher-weights", type=PATH, help="LightGlue: the network, an ONNX file that you have."
    ),
    click.option(
        "--filter",
        type=click.Choice(["ratio", "cross-check"]),
        default=_MATCHING.filter,
        show_default=True,
        help="Keep matches better than the second best, or that are each other's best.",
    ),
    click.option(
        "--ratio",
        type=click.FloatRange(0, 1, min_open=True),
        help="Largest ratio of the best to the second-best distance. "
        f"Default: {_MATCHING.ratio}, on plain pictures 0.8.",
    ),
    click.option(
        "--max-size-ratio",
        type=click.FloatRange(min=1),
        default=_MATCHING.max_size_ratio,
        show_default=True,
        help="Rigid fits: largest ratio of the sizes of two points that match.",
    ),
    click.option("--max-distance", type=POSITIVE, help="Largest distance of two descriptors."),
    click.option(
        "--threshold",
        type=POSITIVE,
        help="Largest residual of an inlier: metres, or pixels without a calibration. "
        "Default: from how well each point is known.",
    ),
    click.option(
        "--confidence",
        type=click.FloatRange(0, 1, min_open=True, max_open=True),
        default=_MATCHING.confidence,
        show_default=True,
        help="RANSAC stops when it has drawn a clean sample with this probability.",
    ),
    click.option(
        "--max-iterations",
        type=click.IntRange(min=1),
        default=_MATCHING.max_iterations,
        show_default=True,
        help="Most samples that RANSAC draws.",
    ),
    click.option(
        "--min-inliers",
        type=click.IntRange(min=2),
        default=_MATCHING.min_inliers,
        show_default=True,
        help="Fewest matches that must agree.",
    ),
    seed,
)
