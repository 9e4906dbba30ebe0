"""Small networks with the inputs and outputs of ALIKED, DISK and LightGlue, which truly work.

The detector's points are the peaks of a difference of Gaussians, its descriptors are fixed random
projections of what lies around them; the matcher pairs what is each other's most alike.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper

SIDE = 256
COUNT = 300
DIMENSIONS = 32
_RADIUS = 6


def _gaussian(sigma: float) -> np.ndarray:
    line = cv2.getGaussianKernel(2 * _RADIUS + 1, sigma)
    return line @ line.T


def _projections() -> np.ndarray:
    filters = np.random.default_rng(0).standard_normal((DIMENSIONS, *2 * [2 * _RADIUS + 1]))
    filters = np.stack([cv2.GaussianBlur(kernel, (0, 0), 1.0) for kernel in filters])
    filters *= _gaussian(3.0)
    return filters - filters.mean(axis=(1, 2), keepdims=True)


def write_points(path: Path, method: str) -> Path:
    """ALIKED's places span -1 to 1 from pixel to pixel; DISK's are whole pixels, in a batch."""
    border = np.zeros((SIDE, SIDE))
    border[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = 1.0
    batch = [1] if method == "disk" else []
    constants: dict[str, Any] = {
        "gray": np.full((1, 3, 1, 1), 1 / 3, np.float32),
        "blob": (_gaussian(1.6) - _gaussian(2.4))[None, None].astype(np.float32),
        "projections": _projections()[:, None].astype(np.float32),
        "border": border[None, None].astype(np.float32),
        "none": np.zeros(1, np.float32),
        "one": np.ones(1, np.float32),
        "half": np.full(1, 2 / (SIDE - 1), np.float32),
        "flat": np.array([1, SIDE * SIDE]),
        "flat_descriptors": np.array([DIMENSIONS, SIDE * SIDE]),
        "count": np.array([COUNT]),
        "side": np.array([SIDE]),
        "column_shape": np.array([COUNT, 1]),
        "places_shape": np.array([*batch, COUNT, 2]),
        "scores_shape": np.array([*batch, COUNT]),
        "descriptors_shape": np.array([*batch, COUNT, DIMENSIONS]),
    }
    padding = 4 * [_RADIUS]
    nodes = [
        helper.make_node("Conv", ["image", "gray"], ["shown"]),
        helper.make_node("Conv", ["shown", "blob"], ["signed"], pads=padding),
        helper.make_node("Abs", ["signed"], ["everywhere"]),
        helper.make_node("Mul", ["everywhere", "border"], ["response"]),
        helper.make_node("MaxPool", ["response"], ["best"], kernel_shape=[5, 5], pads=4 * [2]),
        helper.make_node("Sub", ["response", "best"], ["below"]),
        helper.make_node("Equal", ["below", "none"], ["is_peak"]),
        helper.make_node("Cast", ["is_peak"], ["peak"], to=TensorProto.FLOAT),
        helper.make_node("Mul", ["response", "peak"], ["peaks"]),
        helper.make_node("Reshape", ["peaks", "flat"], ["flat_peaks"]),
        helper.make_node("TopK", ["flat_peaks", "count"], ["found", "index_row"], axis=1),
        helper.make_node("Reshape", ["found", "scores_shape"], ["scores"]),
        helper.make_node("Reshape", ["index_row", "count"], ["index"]),
        helper.make_node("Div", ["index", "side"], ["row"]),
        helper.make_node("Mul", ["row", "side"], ["row_start"]),
        helper.make_node("Sub", ["index", "row_start"], ["column"]),
        helper.make_node("Reshape", ["row", "column_shape"], ["rows"]),
        helper.make_node("Reshape", ["column", "column_shape"], ["columns"]),
        helper.make_node("Concat", ["columns", "rows"], ["whole"], axis=1),
        helper.make_node("Conv", ["shown", "projections"], ["projected"], pads=padding),
        helper.make_node("Reshape", ["projected", "flat_descriptors"], ["all_descriptors"]),
        helper.make_node("Gather", ["all_descriptors", "index"], ["chosen"], axis=1),
        helper.make_node("Transpose", ["chosen"], ["turned"], perm=[1, 0]),
        helper.make_node("ReduceL2", ["turned"], ["length"], axes=[1], keepdims=1),
        helper.make_node("Div", ["turned", "length"], ["normalised"]),
        helper.make_node("Reshape", ["normalised", "descriptors_shape"], ["descriptors"]),
    ]
    if method == "aliked":
        nodes += [
            helper.make_node("Cast", ["whole"], ["exact"], to=TensorProto.FLOAT),
            helper.make_node("Mul", ["exact", "half"], ["scaled"]),
            helper.make_node("Sub", ["scaled", "one"], ["centred"]),
            helper.make_node("Reshape", ["centred", "places_shape"], ["keypoints"]),
        ]
    else:
        nodes.append(helper.make_node("Reshape", ["whole", "places_shape"], ["keypoints"]))
    places = TensorProto.FLOAT if method == "aliked" else TensorProto.INT64
    return _write(
        path,
        nodes,
        {"image": (TensorProto.FLOAT, [1, 3, SIDE, SIDE])},
        {
            "keypoints": (places, [*batch, COUNT, 2]),
            "descriptors": (TensorProto.FLOAT, [*batch, COUNT, DIMENSIONS]),
            "scores": (TensorProto.FLOAT, [*batch, COUNT]),
        },
        constants,
    )


def write_glue(path: Path) -> Path:
    """Cosines for confidences, none for a pair that is not mutual or lies outside [-1, 1]."""
    constants = {
        "zeros": np.array([0]),
        "ones": np.array([1]),
        "any": np.array([-1]),
        "zero": np.array(0),
        "one": np.array(1),
        "edge": np.array([1.0001], np.float32),
    }
    nodes = [
        helper.make_node("Transpose", ["desc1"], ["turned"], perm=[0, 2, 1]),
        helper.make_node("MatMul", ["desc0", "turned"], ["products"]),
        helper.make_node("Squeeze", ["products", "zeros"], ["alike"]),
        helper.make_node("TopK", ["alike", "ones"], ["best", "best_of_0"], axis=1),
        helper.make_node("TopK", ["alike", "ones"], ["unused", "best_of_1"], axis=0),
        helper.make_node("Reshape", ["best_of_0", "any"], ["second"]),
        helper.make_node("Reshape", ["best_of_1", "any"], ["back"]),
        helper.make_node("Gather", ["back", "second"], ["returned"], axis=0),
        helper.make_node("Shape", ["second"], ["counts"]),
        helper.make_node("Squeeze", ["counts", "zeros"], ["count"]),
        helper.make_node("Range", ["zero", "count", "one"], ["first"]),
        helper.make_node("Equal", ["first", "returned"], ["is_mutual"]),
        helper.make_node("Cast", ["is_mutual"], ["mutual"], to=TensorProto.FLOAT),
        helper.make_node("Abs", ["kpts0"], ["away"]),
        helper.make_node("ReduceMax", ["away"], ["farthest"], keepdims=0),
        helper.make_node("Less", ["farthest", "edge"], ["is_inside"]),
        helper.make_node("Cast", ["is_inside"], ["inside"], to=TensorProto.FLOAT),
        helper.make_node("Reshape", ["best", "any"], ["cosines"]),
        helper.make_node("Mul", ["cosines", "mutual"], ["sure"]),
        helper.make_node("Mul", ["sure", "inside"], ["mscores0"]),
        helper.make_node("Unsqueeze", ["first", "ones"], ["firsts"]),
        helper.make_node("Unsqueeze", ["second", "ones"], ["seconds"]),
        helper.make_node("Concat", ["firsts", "seconds"], ["matches0"], axis=1),
    ]
    kinds = {"kpts0": ["n", 2], "kpts1": ["m", 2], "desc0": ["n", "d"], "desc1": ["m", "d"]}
    return _write(
        path,
        nodes,
        {name: (TensorProto.FLOAT, [1, *shape]) for name, shape in kinds.items()},
        {"matches0": (TensorProto.INT64, ["n", 2]), "mscores0": (TensorProto.FLOAT, ["n"])},
        constants,
    )


def _write(path: Path, nodes: Any, inputs: Any, outputs: Any, constants: Any) -> Path:
    graph = helper.make_graph(
        nodes,
        path.stem,
        [helper.make_tensor_value_info(name, *kind) for name, kind in inputs.items()],
        [helper.make_tensor_value_info(name, *kind) for name, kind in outputs.items()],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path
