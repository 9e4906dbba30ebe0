"""The networks of learned features and matching, loaded before the first frame is read."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from slamcli.core.config import FeatureMethod, FeatureOptions, MatchOptions
from slamcli.core.config import NetworkFiles as NetworkFiles
from slamcli.core.errors import InputError
from slamcli.io.networks import load_match_network, load_point_network

LEARNED = ("aliked", "disk")


NO_NETWORKS = NetworkFiles()


def with_point_network(
    options: FeatureOptions, files: NetworkFiles, method: FeatureMethod | Literal["auto"]
) -> FeatureOptions:
    """Return the options with their network, when the method is one; raises InputError."""
    if method == "aliked" or method == "disk":
        if files.weights is None:
            raise InputError(f"--features {method} needs its network: add --weights FILE.onnx")
        network = load_point_network(method, files.weights, files.network_size)
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
    if method not in LEARNED:
        raise InputError(
            f"--matcher lightglue matches the points of --features {' or '.join(LEARNED)}, "
            f"not of {method}"
        )
    return replace(options, network=load_match_network(files.matcher_weights))
