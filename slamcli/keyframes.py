"""Keyframes as they are kept: a twentieth of what comparing two of them needs in memory.

The pixels of a view are kept at half resolution, where comparing them starts, as a JPEG whose
error is below a camera's own noise; the pyramid is made anew from them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import cv2
import numpy as np

from slamcli.core.errors import FrameError
from slamcli.core.records import Keyframe, Prepared
from slamcli.stages import dense

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamcli.core.geometry import Grid

_JPEG_QUALITY = 90
# An expanded keyframe takes some megabytes; a few stand ready.
_MOST_READY = 16


def compress(prepared: Prepared) -> Keyframe:
    """Return a prepared frame, which has features and levels, as it is kept."""
    assert prepared.features is not None
    features, first = prepared.features, prepared.levels[0]
    # OpenCV's SIFT counts in whole numbers, a quarter the size as bytes.
    whole = np.clip(features.descriptors, 0, 255).astype(np.uint8)
    if np.array_equal(whole, features.descriptors):
        features = replace(features, descriptors=whole)
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, image = cv2.imencode(".jpg", first.image, quality)
    _, mask = cv2.imencode(".png", first.mask)
    return Keyframe(
        prepared.index,
        prepared.name,
        prepared.stamp,
        features,
        np.asarray(image).tobytes(),
        np.asarray(mask).tobytes(),
    )


class Expander:
    """Makes keyframes ready to be compared again, the latest few only once; threads may share it.

    A copy or a saved state begins with none of them ready: they are much larger than what they are
    made from.

    Parameters
    ----------
    grid : Grid
        Of the views.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self._ready = lru_cache(maxsize=_MOST_READY)(partial(_expand, grid))

    def __reduce__(self) -> tuple[type[Expander], tuple[Grid]]:
        return Expander, (self.grid,)

    def expand(self, keyframe: Keyframe) -> Prepared:
        """Return a keyframe with its pyramid, but without its view.

        Raises
        ------
        FrameError
            When its pictures are not of the grid's views.
        """
        return self._ready(keyframe)


def _expand(grid: Grid, keyframe: Keyframe) -> Prepared:
    shape = -(-grid.height // 2), -(-grid.width // 2)
    image, mask = _decode(keyframe.image), _decode(keyframe.mask)
    if image is None or mask is None or image.shape != shape or mask.shape != shape:
        raise FrameError(f"keyframe {keyframe.name}: its pictures cannot be used")
    levels = dense.levels_from_half(image, mask, grid)
    features = keyframe.features
    if features.norm == "l2":
        features = replace(features, descriptors=features.descriptors.astype(np.float32))
    return Prepared(
        keyframe.index,
        keyframe.name,
        keyframe.stamp,
        None,
        features,
        "",
        levels,
    )


def _decode(encoded: bytes) -> NDArray[np.uint8] | None:
    """Return the gray picture of a JPEG or PNG; None when it is none."""
    try:
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    return None if picture is None else np.asarray(picture, np.uint8)
