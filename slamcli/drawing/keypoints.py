"""Drawing of the keypoints of an image, and of the regions that the detector did not use."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, UInt8Array
from slamcli.core.records import Keypoints

_LEVEL_COLOURS = ((60, 220, 60), (60, 220, 220), (60, 160, 255), (220, 120, 255))
_CLEANED_COLOUR = (200, 60, 0)
_BORDER_COLOUR = (0, 0, 220)
_TINT = 0.45
_SHIFT = 4
_TEXT_HEIGHT = 22


def draw_keypoints(
    image: UInt8Array,
    keypoints: Keypoints,
    cleaned: BoolArray,
    outside: BoolArray,
) -> UInt8Array:
    """Return the image with each point as a circle of its size and a stroke along its angle.

    Parameters
    ----------
    image : (h, w, 3) uint8 BGR
    keypoints : Keypoints
        Coloured by pyramid level, fine (green) to coarse (violet).
    cleaned, outside : (h, w) bool
        What `clean_image` made black, tinted blue, and what lies outside the region of interest,
        tinted red.

    Returns
    -------
    (h + 22, w, 3) uint8, with a line of text above the image
    """
    tinted = image.astype(np.float32)
    for where, colour in ((cleaned, _CLEANED_COLOUR), (outside, _BORDER_COLOUR)):
        tinted[where] = (1.0 - _TINT) * tinted[where] + _TINT * np.array(colour, np.float32)
    canvas = tinted.astype(np.uint8)
    for pixel, size, angle, octave in zip(
        keypoints.pixels, keypoints.sizes, keypoints.angles, keypoints.octaves, strict=True
    ):
        colour = _LEVEL_COLOURS[min(max(int(octave), 0) // 2, len(_LEVEL_COLOURS) - 1)]
        radius = max(2.0, float(size) / 2.0)
        # Drawn whole, descriptor patches hide their neighbours; a quarter still shows the scale.
        radius = max(2.0, radius / 4.0) if keypoints.norm != "l2" else radius
        centre = _fixed_point(pixel)
        cv2.circle(canvas, centre, round(radius * 2**_SHIFT), colour, 1, cv2.LINE_AA, _SHIFT)
        if math.isnan(angle):
            continue
        end = pixel + radius * np.array(
            [math.cos(math.radians(angle)), math.sin(math.radians(angle))]
        )
        cv2.line(canvas, centre, _fixed_point(end), colour, 1, cv2.LINE_AA, _SHIFT)
    text = f"{len(keypoints)} points, fine green to coarse violet"
    text += f"; blue: cleaned away ({cleaned.mean():.0%})" if cleaned.any() else ""
    text += f"; red: near the border of what was seen ({outside.mean():.0%})"
    header = np.full((_TEXT_HEIGHT, canvas.shape[1], 3), 30, np.uint8)
    cv2.putText(
        header, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (235, 235, 235), 1, cv2.LINE_AA
    )
    return np.vstack([header, canvas])


def _fixed_point(pixel: Float64Array) -> tuple[int, int]:
    """Return a pixel in the fixed-point integers that OpenCV draws fractions of pixels by."""
    return round(float(pixel[0]) * 2**_SHIFT), round(float(pixel[1]) * 2**_SHIFT)
