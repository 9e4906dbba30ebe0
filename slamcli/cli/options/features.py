"""How points are found and described."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.options.common import picked, stacked
from slamcli.cli.options.values import PATH, POSITIVE, Size
from slamcli.core.config import FeatureOptions

if TYPE_CHECKING:
    from slamcli.run.networks import NetworkFiles

_FEATURES = FeatureOptions()

FEATURES = ("orb", "sift", "aliked", "disk")

feature_details = stacked(
    click.option(
        "--weights", type=PATH, help="ALIKED, DISK: the network, an ONNX file that you have."
    ),
    click.option(
        "--network-size",
        type=Size(),
        help="ALIKED, DISK: pixels that the network takes. Default: 640x640, 1024x1024.",
    ),
    click.option(
        "--upright/--no-upright",
        default=_FEATURES.upright,
        help="Describe ORB's and SIFT's points as the robot sees them, for frames that differ "
        "little in heading, or turned with their surroundings [default].",
    ),
    click.option(
        "--spread/--no-spread",
        default=_FEATURES.spread,
        help="Keep the strongest points of every part of the picture [default], or of all of it.",
    ),
    click.option(
        "--refine/--no-refine",
        default=_FEATURES.refine,
        help="Place ORB's points to a fraction of a pixel [default], or on whole pixels.",
    ),
    click.option(
        "--clean/--no-clean",
        default=_FEATURES.clean,
        help="Low-pass the picture and make what is dark black, before [default: not].",
    ),
    click.option(
        "--clean-kernel",
        "clean_kernel_pixels",
        type=click.IntRange(min=1),
        default=_FEATURES.clean_kernel_pixels,
        show_default=True,
        help="Side of that low-pass's box, pixels.",
    ),
    click.option(
        "--clean-threshold",
        type=click.IntRange(0, 255),
        default=_FEATURES.clean_threshold,
        show_default=True,
        help="Gray level up to which it makes black.",
    ),
    click.option(
        "--roi/--no-roi",
        default=_FEATURES.roi,
        help="Leave out points near the border of what was seen [default], or keep them.",
    ),
    click.option(
        "--roi-border",
        "roi_border_pixels",
        type=click.IntRange(min=0),
        default=_FEATURES.roi_border_pixels,
        show_default=True,
        help="How near, in pixels of a point's pyramid level.",
    ),
    click.option(
        "--levels",
        type=click.IntRange(1, 32),
        default=_FEATURES.levels,
        show_default=True,
        help="ORB: levels of the pyramid.",
    ),
    click.option(
        "--scale-factor",
        type=click.FloatRange(1.01, 4.0),
        default=_FEATURES.scale_factor,
        show_default=True,
        help="ORB: from one level to the next.",
    ),
    click.option(
        "--first-level",
        type=click.IntRange(0, 31),
        default=_FEATURES.first_level,
        show_default=True,
        help="ORB: the level that is the picture itself; those below are enlarged.",
    ),
    click.option(
        "--edge-threshold",
        type=click.IntRange(min=1),
        default=_FEATURES.edge_threshold,
        show_default=True,
        help="ORB: pixels left out at each level's border.",
    ),
    click.option(
        "--patch-size",
        type=click.IntRange(min=5),
        default=_FEATURES.patch_size,
        show_default=True,
        help="ORB: pixels that a descriptor compares.",
    ),
    click.option(
        "--wta-k",
        type=click.IntRange(2, 4),
        default=_FEATURES.wta_k,
        show_default=True,
        help="ORB: points compared for each element of a descriptor.",
    ),
    click.option(
        "--fast-threshold",
        type=click.IntRange(1, 255),
        default=_FEATURES.fast_threshold,
        show_default=True,
        help="ORB: contrast of a corner.",
    ),
    click.option(
        "--min-fast-threshold",
        type=click.IntRange(1, 255),
        default=_FEATURES.min_fast_threshold,
        show_default=True,
        help="ORB: tried when that finds too few.",
    ),
    click.option(
        "--contrast-threshold",
        type=POSITIVE,
        default=_FEATURES.contrast_threshold,
        show_default=True,
        help="SIFT: contrast of a point.",
    ),
)


def networks_of(told: Mapping[str, Any]) -> NetworkFiles:
    """Return what the flags say of networks."""
    from slamcli.run.networks import NetworkFiles

    return picked(NetworkFiles, told)
