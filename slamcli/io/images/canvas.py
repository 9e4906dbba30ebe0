"""The canvas: one size for frames of several, each enlarged or laid in its middle."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array

Size = tuple[int, int]
# Pictures whose shapes differ by less are scaled copies of one another.
_SHAPE_TOLERANCE = 0.01


def common_canvas(sizes: Sequence[Size]) -> Size:
    """Return the width and height that pictures of several sizes are brought to.

    The most frequent size, made larger, up to a square, where others of another shape do not fit.
    """
    width, height = max(sizes, key=lambda size: (sizes.count(size), -sizes.index(size)))
    others = [size for size in sizes if not _same_shape(size, (width, height))]
    max_side = max(width, height)
    return (
        min(max_side, max(width, *(size[0] for size in others), 0)),
        min(max_side, max(height, *(size[1] for size in others), 0)),
    )


def canvas_scale(size: Size, canvas: Size) -> float:
    """Return by how much a picture is enlarged on a canvas.

    To fill it when it has its shape, or to fit when it is larger; else not at all.
    """
    factors = canvas[0] / size[0], canvas[1] / size[1]
    return factors[0] if _same_shape(size, canvas) else min(1.0, *factors)


def on_canvas(
    image: UInt8Array, mask: UInt8Array | None, canvas: Size
) -> tuple[UInt8Array, UInt8Array | None]:
    """Return a picture enlarged by `canvas_scale` in the middle of a canvas, with its mask."""
    height, width = image.shape[:2]
    if (width, height) == canvas:
        return image, mask
    scale = canvas_scale((width, height), canvas)
    size = (min(canvas[0], round(scale * width)), min(canvas[1], round(scale * height)))
    known = np.full((height, width), 255, np.uint8) if mask is None else mask
    left, top = (canvas[0] - size[0]) // 2, (canvas[1] - size[1]) // 2
    right, bottom = canvas[0] - size[0] - left, canvas[1] - size[1] - top
    method = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR

    def placed(picture: UInt8Array) -> UInt8Array:
        resized = cv2.resize(picture, size, interpolation=method)
        border = cv2.copyMakeBorder(resized, top, bottom, left, right, cv2.BORDER_CONSTANT)
        return np.asarray(border, np.uint8)

    laid = placed(known)
    whole = mask is None and not (left or top or right or bottom)
    return placed(image), None if whole else np.where(laid > 254, np.uint8(255), np.uint8(0))


def halved(image: UInt8Array) -> UInt8Array:
    """Return an image of half the size, each pixel the mean of two by two."""
    size = image.shape[1] // 2, image.shape[0] // 2
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _same_shape(size: Size, other: Size) -> bool:
    return abs(size[0] * other[1] / (size[1] * other[0]) - 1.0) < _SHAPE_TOLERANCE
