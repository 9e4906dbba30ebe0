"""`slam match`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.features import METHODS, feature_details
from slamcli.cli.options.fields import filled, option, stacked
from slamcli.cli.options.matching import RATIO_TEXT, matching_details, ratio
from slamcli.cli.options.values import PATH, Whole
from slamcli.core.bounds import FEATURES
from slamcli.core.config import FeatureOptions, MatchOptions

_ratio = ratio(
    "PairOptions", f"{RATIO_TEXT} Default: {MatchOptions().ratio} with a calibration, else 0.8."
)

_pair = partial(option, "PairOptions")

_pair_options = stacked(
    _pair(
        "model",
        "--model",
        click.Choice(["rigid", "similarity", "affine", "homography"]),
        "Model of the transform. Default: rigid with a calibration, else similarity.",
    ),
    _pair(
        "method",
        "--features",
        click.Choice(["auto", *METHODS]),
        "Detector and descriptor of feature points. Auto tries ORB and SIFT, on the pictures as "
        "they are and enlarged, and accepts fewer inliers where the pixels agree.",
        default="auto",
    ),
    _pair(
        "count",
        "--count",
        Whole(FEATURES["count"]),
        "Most feature points in a picture. Default: 500, or more with auto.",
    ),
)


@command()
@click.argument("first", type=PATH)
@click.argument("second", type=PATH)
@common.calibration
@common.output("Picture file for a drawing of the matches. A .png or .jpg.")
@_pair_options
@feature_details
@matching_details(_ratio)
@common.json_output
@common.overwrite
def match(
    first: Path,
    second: Path,
    calibration: Path | None,
    output: Path | None,
    as_json: bool,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Estimate the transform between two pictures.

    FIRST and SECOND are image files; the transform maps points of FIRST to SECOND. Where none fits,
    the reason is printed and the exit code is 1.
    """
    from slamcli.run.match import PairOptions
    from slamcli.run.match import match as run_match

    resolved = filled(PairOptions(FeatureOptions(), MatchOptions()), flags)
    report = run_match(first, second, calibration, output, resolved, overwrite=overwrite)
    result(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)
