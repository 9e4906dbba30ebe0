"""The blend of best views: each pixel from the view that resolves it best, along hidden seams."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import Float32Array, IntpArray
from slamcli.stages.mosaic.blend.views import (
    SPARE_CELLS,
    Blended,
    Views,
    best_view,
    dilated,
    enlarged,
    feathered,
    weighted_mean,
    windows_around,
)
from slamcli.stages.mosaic.channels import three_channels
from slamcli.stages.mosaic.tiles import TILE_PIXELS

# Brightness differs slowly: it is smoothed twice over this many cells, and blended over as many.
_LOW_BAND_CELLS = 5
# Of a correction this much is dropped, as nobody sees it; and it is limited to this much.
_UNSEEN_GRAY, _MAX_CORRECTION_GRAY = 1.0, 40.0
# Cells that differ by less than this from those around are plain floor.
# [All of these are guarded by benchmarks/blends.py.]
_PLAIN_GRAY = 16.0


def blend_best(views: Views) -> Blended:
    """Take each pixel from the view that resolves it best, and hide the seams.

    In two bands (after Burt & Adelson, ACM Trans. Graphics 2(4), 1983): the low one, brightness,
    passes from view to view over several cells; texture changes over within half a cell, so that
    no wider strip of it is ever mixed.
    """
    label = best_view(views.weights)
    corrections = _low_band_corrections(views, label)
    total = np.zeros((TILE_PIXELS, TILE_PIXELS, 3), np.float32)
    share = np.zeros((TILE_PIXELS, TILE_PIXELS), np.float32)
    pixels_per_metre = np.zeros_like(share)
    for number in np.unique(label[label >= 0]):
        own = (label == number).astype(np.float32)
        # Between cells, what a view may claim reaches half a cell farther.
        for window in windows_around(dilated(own, SPARE_CELLS + 1) > 0):
            read = views.read(int(number), window)
            alpha = feathered(own, window) * (read.weight > 0)
            part = window.pixels
            colour = cv2.add(read.image, enlarged(corrections[number], window), dtype=cv2.CV_32F)
            cv2.accumulateProduct(colour, three_channels(alpha), total[part])
            share[part] += alpha
            here = pixels_per_metre[part]
            np.maximum(here, read.pixels_per_metre, out=here, where=alpha > 0)
    resolution = np.where(share > 0, pixels_per_metre, np.float32(0.0))
    return Blended(weighted_mean(total, share), resolution)


def _low_band_corrections(views: Views, label: IntpArray) -> dict[int, Float32Array]:
    """Return for each view that is best somewhere (h, w, 3): what blends its low band in.

    The low band is what a view differs by from the composite of all best views, smoothed where that
    is plain: beside an edge a difference is due to poses and blur, not to brightness.
    """
    numbers = [int(number) for number in np.unique(label[label >= 0])]
    composite = np.take_along_axis(views.cells, np.maximum(label, 0)[None, ..., None], axis=0)[0]
    around = np.ones((3, 3), np.uint8)
    gradient = cv2.morphologyEx(composite, cv2.MORPH_GRADIENT, around)
    span = np.asarray(gradient, np.float32).max(axis=-1)
    plain = np.where(label >= 0, 1.0 / (1.0 + (span / _PLAIN_GRAY) ** 2), 0.0).astype(np.float32)
    low, reach = {}, {}
    total = np.zeros(composite.shape, np.float32)
    share = np.full(label.shape, 1e-6, np.float32)
    for number in numbers:
        seen = (views.weights[number] > 0).astype(np.float32)
        difference = views.cells[number].astype(np.float32) - composite
        area = _smooth(seen * plain)
        low[number] = _smooth(difference * (seen * plain)[..., None])
        low[number] /= np.maximum(area, np.float32(1e-3))[..., None]
        reach[number] = _smooth((label == number).astype(np.float32)) * seen
        total += reach[number][..., None] * low[number]
        share += reach[number]
    target = total / share[..., None]
    return {number: _limited(target - low[number]) for number in numbers}


def _limited(correction: NDArray[np.floating]) -> Float32Array:
    """Return corrections shrunk by what nobody sees, and limited."""
    size = np.abs(correction) - np.float32(_UNSEEN_GRAY)
    limited = np.clip(size, 0.0, _MAX_CORRECTION_GRAY)
    return np.asarray(np.copysign(limited, correction), np.float32)


def _smooth(values: Float32Array) -> Float32Array:
    """Blur by a box twice, nothing beyond the border."""
    box = (_LOW_BAND_CELLS, _LOW_BAND_CELLS)
    once = cv2.blur(values, box, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(cv2.blur(once, box, borderType=cv2.BORDER_CONSTANT), np.float32)
