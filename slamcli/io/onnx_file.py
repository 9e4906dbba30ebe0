"""ONNX files: a network's graph as OpenCV reads it, written without the package onnx.

The format is that of onnx.proto3 (opset 16): protocol buffers, of which few kinds of fields are
needed. Source: https://onnx.ai/onnx/repo-docs/IR.html.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from slamcli.core.arrays import Float32Array, Int64Array

_IR_VERSION, _OPSET = 8, 16
_FLOAT, _INT64 = 1, 7
# The numbers of AttributeProto's kinds.
_KIND_FLOAT, _KIND_INT, _KIND_STRING, _KIND_INTS = 1, 2, 3, 7

# Of outputs: batch, channels, rows, columns.
_OPEN_SHAPE = (0, 0, 0, 0)

Attribute = float | int | str | Sequence[int]


class OnnxGraph:
    """The graph of a network, built node by node.

    Tensors are known by their names: those of inputs are given, all others are made up here.
    """

    def __init__(self) -> None:
        self._nodes: list[bytes] = []
        self._constants: list[bytes] = []
        self._inputs: list[bytes] = []
        self._names = 0

    def input(self, name: str, shape: Sequence[int]) -> str:
        """Declare a float32 input, and return its name."""
        self._inputs.append(_value(name, shape))
        return name

    def constant(self, values: Float32Array | Int64Array) -> str:
        """Add an array, and return its name."""
        name = self._new_name()
        kind = _INT64 if values.dtype == np.int64 else _FLOAT
        # In the file's order of bytes, whatever the machine's.
        raw = values.astype("<i8" if kind == _INT64 else "<f4").tobytes()
        dimensions = b"".join(_int(1, side) for side in values.shape)
        fields = (dimensions, _int(2, kind), _text(8, name), _bytes(9, raw))
        self._constants.append(b"".join(fields))
        return name

    def node(self, operator: str, *inputs: str, **attributes: Attribute) -> str:
        """Add an operator with one output, and return the output's name."""
        name = self._new_name()
        self._nodes.append(_node(operator, inputs, name, attributes))
        return name

    def convolution(
        self, source: str, weights: Float32Array, bias: Float32Array, stride: int = 1, pad: int = 0
    ) -> str:
        """Add a convolution by (C_out, C_in, k, k) weights, and return its output's name."""
        inputs = (source, self.constant(weights), self.constant(bias))
        strides, pads = (stride, stride), (pad, pad, pad, pad)
        kernel = weights.shape[2:]
        return self.node("Conv", *inputs, kernel_shape=kernel, strides=strides, pads=pads)

    def to_bytes(self, outputs: dict[str, str]) -> bytes:
        """Return the file's content.

        Parameters
        ----------
        outputs : dict of str to str
            The name of each output, and of the tensor that it is.
        """
        last = [_node("Identity", (name,), given, {}) for given, name in outputs.items()]
        graph = b"".join(
            [
                *(_bytes(1, node) for node in (*self._nodes, *last)),
                _text(2, "network"),
                *(_bytes(5, constant) for constant in self._constants),
                *(_bytes(11, value) for value in self._inputs),
                *(_bytes(12, _value(name, _OPEN_SHAPE)) for name in outputs),
            ]
        )
        opset = _text(1, "") + _int(2, _OPSET)
        return _int(1, _IR_VERSION) + _bytes(7, graph) + _bytes(8, opset)

    def _new_name(self) -> str:
        self._names += 1
        return f"t{self._names}"


def _node(
    operator: str, inputs: Sequence[str], output: str, attributes: dict[str, Attribute]
) -> bytes:
    fields = [
        *(_text(1, name) for name in inputs),
        _text(2, output),
        _text(3, output),
        _text(4, operator),
        *(_bytes(5, _attribute(name, value)) for name, value in attributes.items()),
    ]
    return b"".join(fields)


def _attribute(name: str, value: Attribute) -> bytes:
    if isinstance(value, str):
        return _text(1, name) + _text(4, value) + _int(20, _KIND_STRING)
    if isinstance(value, int):
        return _text(1, name) + _int(3, value) + _int(20, _KIND_INT)
    if isinstance(value, float):
        return _text(1, name) + _key(2, 5) + struct.pack("<f", value) + _int(20, _KIND_FLOAT)
    return _text(1, name) + b"".join(_int(8, one) for one in value) + _int(20, _KIND_INTS)


def _value(name: str, shape: Sequence[int]) -> bytes:
    """Return a ValueInfoProto of float32; sides of 0 are left open."""
    sides = b"".join(_bytes(1, _int(1, side) if side else _text(2, "n")) for side in shape)
    tensor = _int(1, _FLOAT) + _bytes(2, sides)
    return _text(1, name) + _bytes(2, _bytes(1, tensor))


def _key(field: int, wire_type: int) -> bytes:
    return _varint(field << 3 | wire_type)


def _int(field: int, value: int) -> bytes:
    return _key(field, 0) + _varint(value)


def _bytes(field: int, content: bytes) -> bytes:
    return _key(field, 2) + _varint(len(content)) + content


def _text(field: int, content: str) -> bytes:
    return _bytes(field, content.encode())


def _varint(value: int) -> bytes:
    """Return a whole number of 64 bits, seven to a byte, the lowest first."""
    value &= (1 << 64) - 1
    found = bytearray()
    while value > 127:
        found.append(value & 127 | 128)
        value >>= 7
    return bytes([*found, value])
