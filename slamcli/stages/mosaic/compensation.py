"""Exposure compensation: a frame's gain and the lens's vignetting taken out of an image."""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, UInt8Array
from slamcli.core.camera.lens import image_centre
from slamcli.stages.mosaic.channels import three_channels

# From this gray on a pixel may be saturated [guarded by benchmarks/blends.py].
_NEARLY_WHITE_GRAY = 235.0


def correct(image: UInt8Array, gain: float, brightening: Float32Array | None) -> UInt8Array:
    """Return an image (h, w, 3) with its gain and the lens's vignetting compensated.

    Parameters
    ----------
    brightening : (h, w) float32 or None
        What undoes the vignetting, from `brightening_image`; None when the lens is even.
    """
    if gain != 1.0:
        levels = np.arange(256.0)
        # A saturated pixel was at least as bright: it stays white where the rest is darkened.
        share = np.clip((levels - _NEARLY_WHITE_GRAY) / (255.0 - _NEARLY_WHITE_GRAY), 0.0, 1.0)
        kept = share if gain < 1.0 else np.zeros_like(share)
        table = np.clip(np.rint(levels * (gain + kept * (1.0 - gain))), 0, 255).astype(np.uint8)
        image = np.asarray(cv2.LUT(image, table), np.uint8)
    if brightening is None:
        return image
    factor = three_channels(brightening)
    return np.asarray(cv2.multiply(image, factor, dtype=cv2.CV_8U), np.uint8)


def brightening_image(
    image_size: tuple[int, int], vignetting: tuple[float, float], step: int = 1
) -> Float32Array | None:
    """Return (h, w): what undoes the vignetting, at every `step`-th pixel; None when there is none.

    The last row and column lie on the image's border or beyond it.
    """
    if vignetting == (0.0, 0.0):
        return None
    centre_x, centre_y = image_centre(image_size)
    columns, rows = (step * np.arange(-(-(side - 1) // step) + 1) for side in image_size)
    across, down = (columns - centre_x) ** 2, (rows - centre_y) ** 2
    radius = (across[None, :] + down[:, None]) / (centre_x**2 + centre_y**2)
    return np.exp(vignetting[0] * radius + vignetting[1] * radius**2).astype(np.float32)
