"""Blends that average all views of a pixel: mean, feathered mean and median."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Int16Array
from slamcli.stages.mosaic.blend.views import (
    Blended,
    CellWindow,
    Views,
    dilated,
    weighted_mean,
    window_around,
)
from slamcli.stages.mosaic.channels import three_channels
from slamcli.stages.mosaic.sampling import Sample
from slamcli.stages.mosaic.tiles import CELL_PIXELS, TILE_PIXELS

# The median is computed for this many rows at a time, to limit its memory.
_MEDIAN_ROWS = 64


def blend_mean(views: Views) -> Blended:
    """Return the plain mean of all views."""
    return _mean(views, lambda weight: (weight > 0).astype(np.float32))


def blend_feather(views: Views) -> Blended:
    """Return the mean of all views, weighted by resolution and feathered towards their borders."""
    return _mean(views, lambda weight: weight)


def blend_median(views: Views) -> Blended:
    """Return the median of all views, a channel at a time."""
    images, pixels_per_metre = _read_all(views)
    image = np.zeros(images.shape[1:], np.uint8)
    for row in range(0, TILE_PIXELS, _MEDIAN_ROWS):
        rows = slice(row, row + _MEDIAN_ROWS)
        seen = pixels_per_metre[:, rows] > 0
        count = seen.sum(axis=0)
        # What is not seen sorts to the end.
        values = np.sort(np.where(seen[..., None], images[:, rows], np.int16(256)), axis=0)
        low, high = (
            np.take_along_axis(values, np.clip(rank, 0, len(values) - 1)[None, ..., None], axis=0)[
                0
            ]
            for rank in ((count - 1) // 2, count // 2)
        )
        both = (low.astype(np.int32) + high + 1) // 2
        image[rows] = np.where(count[..., None] > 0, np.minimum(both, 255), 0)
    return Blended(image, pixels_per_metre.max(axis=0))


def _mean(views: Views, measure: Callable[[Float32Array], Float32Array]) -> Blended:
    total = np.zeros((TILE_PIXELS, TILE_PIXELS, 3), np.float32)
    share = np.zeros((TILE_PIXELS, TILE_PIXELS), np.float32)
    pixels_per_metre = np.zeros_like(share)
    for number, window, read in _reads(views):
        weight = measure(_floor_weight(views, number, window, read))
        colour = read.image.astype(np.float32)
        cv2.accumulateProduct(colour, three_channels(weight), total[window.pixels])
        share[window.pixels] += weight
        here = pixels_per_metre[window.pixels]
        np.maximum(here, read.pixels_per_metre, out=here, where=weight > 0)
    return Blended(weighted_mean(total, share), pixels_per_metre)


def _read_all(views: Views) -> tuple[Int16Array, Float32Array]:
    """Return what all views show (N, h, w, 3), and their resolution; 0 where not of the floor."""
    found = _reads(views)
    images = np.zeros((max(1, len(found)), TILE_PIXELS, TILE_PIXELS, 3), np.int16)
    pixels_per_metre = np.zeros(images.shape[:3], np.float32)
    for index, (number, window, read) in enumerate(found):
        images[index][window.pixels] = read.image
        seen = _floor_weight(views, number, window, read) > 0
        pixels_per_metre[index][window.pixels] = np.where(
            seen, read.pixels_per_metre, np.float32(0.0)
        )
    return images, pixels_per_metre


def _reads(views: Views) -> list[tuple[int, CellWindow, Sample]]:
    """Read every view of the tile where it sees something."""
    found = []
    for number, weight in enumerate(views.weights):
        window = window_around(dilated((weight > 0).astype(np.float32), 1) > 0)
        if window is not None:
            found.append((number, window, views.read(number, window)))
    return found


def _floor_weight(views: Views, number: int, window: CellWindow, read: Sample) -> Float32Array:
    """Return a view's weight, 0 in the cells where it does not show the floor.

    The cells at the rim of what it sees have their centres outside, and keep their weight.
    """
    others = (views.weights > 0).any(axis=0) & (views.weights[number] <= 0)
    hidden = others[window.cells].repeat(CELL_PIXELS, axis=0).repeat(CELL_PIXELS, axis=1)
    return np.where(hidden, np.float32(0.0), read.weight)
