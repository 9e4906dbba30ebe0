"""What the mapper is bound to when it places frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import click

from slamcli.cli.options.common import picked, stacked
from slamcli.cli.options.features import FEATURES
from slamcli.cli.options.values import NOT_NEGATIVE, POSITIVE
from slamcli.core.config import FeatureOptions, MapperOptions, MatchOptions

_MAPPER = MapperOptions()

mapper_options = stacked(
    click.option(
        "--features",
        "method",
        type=click.Choice(FEATURES),
        default=_MAPPER.features.method,
        show_default=True,
    ),
    click.option(
        "--count",
        type=click.IntRange(min=1),
        default=_MAPPER.features.count,
        show_default=True,
        help="Most features a frame.",
    ),
    click.option(
        "--view-metres-per-pixel",
        type=POSITIVE,
        help="Resolution of the views that are matched. Default: from the camera's sampling.",
    ),
    click.option(
        "--recent-keyframes",
        type=click.IntRange(min=1),
        default=_MAPPER.recent_keyframes,
        show_default=True,
        help="How many keyframes back a frame is compared with.",
    ),
    click.option(
        "--keyframe-overlap",
        type=click.FloatRange(0, 1),
        default=_MAPPER.keyframe_overlap,
        show_default=True,
        help="A frame that shares less floor with the latest keyframe becomes one.",
    ),
    click.option(
        "--min-overlap",
        type=click.FloatRange(0, 1),
        default=_MAPPER.min_overlap,
        show_default=True,
        help="Least share of floor that a believed fit leaves in common.",
    ),
    click.option(
        "--max-turn",
        type=click.FloatRange(0, 180),
        default=_MAPPER.max_turn_degrees,
        show_default=True,
        help="Degrees: most that the robot turns between two frames that are compared.",
    ),
    click.option(
        "--min-score",
        type=click.FloatRange(-1, 1),
        default=_MAPPER.min_score,
        show_default=True,
        help="Least correlation of the overlap's pixels for a fit to be believed.",
    ),
    click.option(
        "--tilt-sigma",
        type=NOT_NEGATIVE,
        default=_MAPPER.tilt_sigma_degrees,
        show_default=True,
        help="Degrees by which the camera's pitch varies from frame to frame.",
    ),
    click.option(
        "--dense/--no-dense",
        default=_MAPPER.dense,
        help="Search the pixels for the motion where features do not convince [default], or not.",
    ),
    click.option(
        "--search-angle",
        type=click.FloatRange(0, 180),
        default=_MAPPER.search_angle_degrees,
        show_default=True,
        help="Degrees of turn to either side that this search tries.",
    ),
    click.option(
        "--max-rival",
        type=click.FloatRange(0, 1),
        default=_MAPPER.max_rival_evidence,
        show_default=True,
        help="A motion is ambiguous when another explains more than this share of what it does.",
    ),
    click.option(
        "--max-step",
        "max_step_metres",
        type=POSITIVE,
        help="Metres; the farthest that the robot goes from one frame to the next. On a floor that "
        "repeats, less than half its period tells which of its like spots is meant.",
    ),
    click.option(
        "--loops/--no-loops",
        default=_MAPPER.loops,
        help="Look for floor that was seen before [default], or take the frames as a chain.",
    ),
    click.option(
        "--refine-pixels/--no-refine-pixels",
        default=_MAPPER.refine,
        help="Refine each fit on the pixels themselves [default], or leave it to the features.",
    ),
)


def mapper_of(told: Mapping[str, Any]) -> MapperOptions:
    """Return what the flags of a command that maps ask for."""
    return MapperOptions(
        features=picked(FeatureOptions, told),
        matching=picked(MatchOptions, told),
        metres_per_pixel=told["view_metres_per_pixel"],
        recent_keyframes=told["recent_keyframes"],
        keyframe_overlap=told["keyframe_overlap"],
        min_overlap=told["min_overlap"],
        max_turn_degrees=told["max_turn"],
        min_score=told["min_score"],
        tilt_sigma_degrees=told["tilt_sigma"],
        refine=told["refine_pixels"],
        dense=told["dense"],
        search_angle_degrees=told["search_angle"],
        max_rival_evidence=told["max_rival"],
        max_step_metres=told["max_step_metres"],
        loops=told["loops"],
    )
