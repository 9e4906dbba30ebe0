"""Options of feature detection and description."""

from __future__ import annotations

from typing import Any

import click

from slamcli.cli.options.fields import Decorator, option, stacked
from slamcli.cli.options.values import AT_LEAST_ONE, PATH, POSITIVE, Numbers
from slamcli.core.config import FeatureOptions, NetworkFiles

_FEATURES, _NETWORKS = FeatureOptions(), NetworkFiles()

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
    option(
        _NETWORKS,
        "weights",
        "--weights",
        PATH,
        "ALIKED, DISK: the network, an ONNX file of your own.",
    ),
    option(
        _NETWORKS,
        "network_size",
        "--network-size",
        SIZE,
        "ALIKED, DISK: size in pixels of the picture that the network takes. Default: 640x640 for "
        "ALIKED, 1024x1024 for DISK.",
    ),
    option(
        _FEATURES,
        "upright",
        "--upright/--no-upright",
        text="ORB, SIFT: describe points without rotation invariance, for frames that differ "
        "little in heading.",
    ),
    option(
        _FEATURES,
        "spread",
        "--spread/--no-spread",
        text="Keep the strongest points of every part of the picture, not the strongest of all.",
    ),
    option(
        _FEATURES,
        "refine",
        "--refine/--no-refine",
        text="ORB: refine points to sub-pixel positions.",
    ),
    option(
        _FEATURES,
        "clean",
        "--clean/--no-clean",
        text="Before detection, low-pass the picture and turn its dark pixels black.",
    ),
    option(
        _FEATURES,
        "clean_kernel_pixels",
        "--clean-kernel",
        AT_LEAST_ONE,
        "--clean: side of the low-pass's box, in pixels.",
    ),
    option(
        _FEATURES,
        "clean_threshold",
        "--clean-threshold",
        click.IntRange(0, 255),
        "--clean: gray level up to which a pixel turns black.",
    ),
    option(
        _FEATURES,
        "roi",
        "--roi/--no-roi",
        text="Leave out points near the border of the region seen (region of interest).",
    ),
    option(
        _FEATURES,
        "roi_border_pixels",
        "--roi-border",
        click.IntRange(min=0),
        "--roi: width of that border, in pixels of the point's pyramid level.",
    ),
    option(
        _FEATURES, "levels", "--levels", click.IntRange(1, 32), "ORB: number of pyramid levels."
    ),
    option(
        _FEATURES,
        "scale_factor",
        "--scale-factor",
        click.FloatRange(1.01, 4.0),
        "ORB: scale from one pyramid level to the next.",
    ),
    option(
        _FEATURES,
        "first_level",
        "--first-level",
        click.IntRange(0, 31),
        "ORB: the pyramid level that is the picture itself; levels below it are enlarged.",
    ),
    option(
        _FEATURES,
        "edge_threshold",
        "--edge-threshold",
        AT_LEAST_ONE,
        "ORB: pixels left out at each level's border.",
    ),
    option(
        _FEATURES,
        "patch_size",
        "--patch-size",
        click.IntRange(min=5),
        "ORB: side in pixels of the patch that a descriptor covers.",
    ),
    option(
        _FEATURES,
        "wta_k",
        "--wta-k",
        click.IntRange(2, 4),
        "ORB: points compared for each element of a descriptor.",
    ),
    option(
        _FEATURES,
        "fast_threshold",
        "--fast-threshold",
        click.IntRange(1, 255),
        "ORB: contrast of a corner.",
    ),
    option(
        _FEATURES,
        "min_fast_threshold",
        "--min-fast-threshold",
        click.IntRange(1, 255),
        "ORB: contrast of a corner where --fast-threshold finds too few.",
    ),
    option(
        _FEATURES,
        "contrast_threshold",
        "--contrast-threshold",
        POSITIVE,
        "SIFT: contrast of a point.",
    ),
)
