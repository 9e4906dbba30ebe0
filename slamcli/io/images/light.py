"""Light that stays in the picture while the floor moves: of a lamp, a lens, dust on a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array


@dataclass(frozen=True, slots=True, eq=False)
class StaticLight:
    """A pattern of brightness that all frames share.

    Attributes
    ----------
    gain : (h, w) float32
        What evens it out; smaller than the pictures, of their shape.
    """

    gain: Float32Array

    def evened(self, image: UInt8Array) -> UInt8Array:
        """Return a picture without the pattern."""
        height, width = image.shape[:2]
        gain = cv2.resize(self.gain, (width, height), interpolation=cv2.INTER_LINEAR)
        if image.ndim == 3:
            gain = np.repeat(np.asarray(gain)[:, :, None], image.shape[2], axis=2)
        return np.asarray(cv2.multiply(image, gain, dtype=cv2.CV_8U), np.uint8)
