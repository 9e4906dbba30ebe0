"""Keyframes as they are kept: a twentieth of what comparing two of them needs in memory.

The pixels of a view are kept at half resolution, where comparing them starts, as a JPEG whose
error is below a camera's own noise; the pyramid is made anew from them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.errors import FrameError
from slamcli.core.geometry import Grid
from slamcli.core.records import Keyframe, PreparedFrame
from slamcli.stages import dense

_JPEG_QUALITY = 90
# An expanded keyframe takes some megabytes; a few stand ready. Most cameras' views have one mask.
_MAX_READY, _MAX_MASKS = 16, 4


def encode_keyframe(prepared: PreparedFrame) -> Keyframe:
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


class KeyframeCache:
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
        stencils = lru_cache(maxsize=_MAX_MASKS)(partial(_stencils, grid))
        self._ready = lru_cache(maxsize=_MAX_READY)(partial(_expand, grid, stencils))

    def __reduce__(self) -> tuple[type[KeyframeCache], tuple[Grid]]:
        return KeyframeCache, (self.grid,)

    def decode(self, keyframe: Keyframe) -> PreparedFrame:
        """Return a keyframe with its pyramid, but without its view.

        Raises
        ------
        FrameError
            When its pictures are not of the grid's views.
        """
        return self._ready(keyframe)


def _expand(
    grid: Grid, stencils_of: Callable[[bytes], Sequence[dense.LevelMask]], keyframe: Keyframe
) -> PreparedFrame:
    image, stencils = _decode(keyframe.image, grid), stencils_of(keyframe.mask)
    if image is None or not stencils:
        raise FrameError(f"keyframe {keyframe.name}: its pictures cannot be used")
    levels = dense.levels_from_half(image, stencils, grid)
    features = keyframe.features
    if features.norm == "l2":
        features = replace(features, descriptors=features.descriptors.astype(np.float32))
    return PreparedFrame(
        keyframe.index,
        keyframe.name,
        keyframe.stamp,
        None,
        features,
        "",
        levels,
    )


def _stencils(grid: Grid, encoded: bytes) -> tuple[dense.LevelMask, ...]:
    """Return the stencils of a keyframe's mask; none when it cannot be used."""
    mask = _decode(encoded, grid)
    return () if mask is None else dense.level_masks_from_half(mask)


def _decode(encoded: bytes, grid: Grid) -> UInt8Array | None:
    """Return the gray picture of a JPEG or PNG; None when it is none of a grid's views, halved."""
    try:
        picture = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    shape = -(-grid.height // 2), -(-grid.width // 2)
    return None if picture is None or picture.shape != shape else np.asarray(picture, np.uint8)
