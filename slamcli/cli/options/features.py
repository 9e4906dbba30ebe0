"""Options of feature detection and description."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from slamcli.cli.options.fields import Decorator, option, stacked
from slamcli.cli.options.values import AT_LEAST_ONE, PATH, POSITIVE, Numbers
from slamcli.core.config import FeatureOptions, NetworkFiles

_feature = partial(option, FeatureOptions())
_network = partial(option, NetworkFiles())

METHODS = ("orb", "sift", "aliked", "disk")

SIZE = Numbers("WxH", 2, separator="x", min_whole=64)


def feature_kind(group: FeatureOptions) -> Decorator[Any]:
    """Return the options --features and --count, with a dataclass's defaults."""
    return stacked(
        option(
            group,
            "method",
            "--features",
            click.Choice(METHODS),
            "Detector and descriptor of feature points.",
        ),
        option(group, "count", "--count", AT_LEAST_ONE, "Most feature points in a frame."),
    )


feature_details = stacked(
    _network("weights", "--weights", PATH, "ALIKED, DISK: the network, an ONNX file of your own."),
    _network(
        "network_size",
        "--network-size",
        SIZE,
        "ALIKED, DISK: size in pixels of the picture that the network takes. Default: 640x640 for "
        "ALIKED, 1024x1024 for DISK.",
    ),
    _feature(
        "upright",
        "--upright/--no-upright",
        text="ORB, SIFT: describe points without rotation invariance, for frames that differ "
        "little in heading.",
    ),
    _feature(
        "spread",
        "--spread/--no-spread",
        text="Keep the strongest points of every part of the picture, not the strongest of all.",
    ),
    _feature("refine", "--refine/--no-refine", text="ORB: refine points to sub-pixel positions."),
    _feature(
        "clean",
        "--clean/--no-clean",
        text="Before detection, low-pass the picture and turn its dark pixels black.",
    ),
    _feature(
        "clean_kernel_pixels",
        "--clean-kernel",
        AT_LEAST_ONE,
        "--clean: side of the low-pass's box, in pixels.",
    ),
    _feature(
        "clean_threshold",
        "--clean-threshold",
        click.IntRange(0, 255),
        "--clean: gray level up to which a pixel turns black.",
    ),
    _feature(
        "roi",
        "--roi/--no-roi",
        text="Leave out points near the border of the region seen (region of interest).",
    ),
    _feature(
        "roi_border_pixels",
        "--roi-border",
        click.IntRange(min=0),
        "--roi: width of that border, in pixels of the point's pyramid level.",
    ),
    _feature("levels", "--levels", click.IntRange(1, 32), "ORB: number of pyramid levels."),
    _feature(
        "scale_factor",
        "--scale-factor",
        click.FloatRange(1.01, 4.0),
        "ORB: scale from one pyramid level to the next.",
    ),
    _feature(
        "first_level",
        "--first-level",
        click.IntRange(0, 31),
        "ORB: the pyramid level that is the picture itself; levels below it are enlarged.",
    ),
    _feature(
        "edge_threshold",
        "--edge-threshold",
        AT_LEAST_ONE,
        "ORB: pixels left out at each level's border.",
    ),
    _feature(
        "patch_size",
        "--patch-size",
        click.IntRange(min=5),
        "ORB: side in pixels of the patch that a descriptor covers.",
    ),
    _feature(
        "wta_k",
        "--wta-k",
        click.IntRange(2, 4),
        "ORB: points compared for each element of a descriptor.",
    ),
    _feature(
        "fast_threshold", "--fast-threshold", click.IntRange(1, 255), "ORB: contrast of a corner."
    ),
    _feature(
        "min_fast_threshold",
        "--min-fast-threshold",
        click.IntRange(1, 255),
        "ORB: contrast of a corner where --fast-threshold finds too few.",
    ),
    _feature("contrast_threshold", "--contrast-threshold", POSITIVE, "SIFT: contrast of a point."),
)
