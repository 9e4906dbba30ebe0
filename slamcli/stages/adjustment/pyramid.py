"""The image pyramid in which patches are tracked."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array

MAX_LEVEL = 3
# Smooths the noise that a gradient would amplify [guarded by benchmarks/self_calibration.py].
_SMOOTHING_PIXELS = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """A gray image at full size, half, a quarter and so on.

    Attributes
    ----------
    images : tuple of (h, w) float32
    masks : tuple of (h, w) uint8
        255 where the image shows usable floor.
    """

    images: tuple[Float32Array, ...]
    masks: tuple[UInt8Array, ...]


def make_pyramid(image: UInt8Array, mask: UInt8Array) -> Pyramid:
    """Return the levels of a gray image (H, W) whose usable floor has 255 in the mask."""
    level = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _SMOOTHING_PIXELS)
    images, masks = [np.asarray(level, np.float32)], [mask]
    for _ in range(MAX_LEVEL):
        images.append(np.asarray(cv2.pyrDown(images[-1]), np.float32))
        masks.append(np.asarray(cv2.pyrDown(masks[-1]), np.uint8))
    return Pyramid(tuple(images), tuple(masks))
