"""Multi-band blending over a Laplacian pyramid (Burt and Adelson, 1983)."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, IntpArray
from slamcli.stages.mosaic.blend.views import Blended, CellWindow, Views, best_view, feathered
from slamcli.stages.mosaic.sampling import Sample
from slamcli.stages.mosaic.tiles import CELL_PIXELS, TILE_PIXELS

# Octaves below the full resolution, and the margin over which the coarsest passes from view to
# view [guarded by benchmarks/blends.py].
_LEVELS = 4
_MARGIN_CELLS = 8


def blend_multiband(views: Views) -> Blended:
    """Return Burt and Adelson's multi-resolution spline of the views that see a spot best.

    Each octave of detail passes from view to view over its own width (ACM Trans. Graphics 2(4),
    1983); where a view sees nothing it is taken to show what the others do.
    """
    label = best_view(views.weights)
    count = TILE_PIXELS // CELL_PIXELS + 2 * _MARGIN_CELLS
    whole = CellWindow(-_MARGIN_CELLS, -_MARGIN_CELLS, count, count)
    chosen = [int(number) for number in np.unique(label[whole.cells]) if number >= 0]
    reads = [views.read(number, whole) for number in chosen]
    side = count * CELL_PIXELS
    shares, seen = _shares(label, whole, chosen, reads)
    backdrop = np.zeros((side, side, 3), np.float32)
    for share, read in zip(shares, reads, strict=True):
        backdrop += share[..., None] * read.image
    image = _spline(shares, reads, backdrop)
    pixels_per_metre = np.zeros((side, side), np.float32)
    for share, read in zip(shares, reads, strict=True):
        np.maximum(pixels_per_metre, read.pixels_per_metre, out=pixels_per_metre, where=share > 0)
    inner = slice(_MARGIN_CELLS * CELL_PIXELS, side - _MARGIN_CELLS * CELL_PIXELS)
    rounded = np.clip(np.rint(np.where(seen[..., None], image, 0.0)), 0, 255)
    return Blended(rounded[inner, inner].astype(np.uint8), pixels_per_metre[inner, inner])


def _shares(
    label: IntpArray, window: CellWindow, chosen: list[int], reads: list[Sample]
) -> tuple[list[Float32Array], BoolArray]:
    """Return each view's share of every pixel, which sum to 1, and (h, w): where any has one."""
    shares = []
    for number, read in zip(chosen, reads, strict=True):
        own = (label == number).astype(np.float32)
        shares.append(feathered(own, window) * (read.weight > 0))
    side = window.height * CELL_PIXELS
    total = np.sum(shares, axis=0) if shares else np.zeros((side, side), np.float32)
    for share in shares:
        np.divide(share, total, out=share, where=total > 0)
    return shares, total > 0


def _spline(
    shares: list[Float32Array], reads: list[Sample], backdrop: Float32Array
) -> Float32Array:
    """Return (h, w, 3): the views' Laplacian pyramids, averaged by the Gaussian ones of shares."""
    bands = [np.zeros_like(level) for level in _gaussian_pyramid(backdrop)]
    sums = [np.full(band.shape[:2], 1e-6, np.float32) for band in bands]
    for share, read in zip(shares, reads, strict=True):
        filled = np.where(read.weight[..., None] > 0, read.image, backdrop).astype(np.float32)
        levels = zip(_laplacian_pyramid(filled), _gaussian_pyramid(share), strict=True)
        for depth, (detail, mask) in enumerate(levels):
            bands[depth] += detail * mask[..., None]
            sums[depth] += mask
    return _collapsed([band / one[..., None] for band, one in zip(bands, sums, strict=True)])


def _gaussian_pyramid(image: Float32Array) -> list[Float32Array]:
    levels = [image]
    for _ in range(_LEVELS):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return levels


def _laplacian_pyramid(image: Float32Array) -> list[Float32Array]:
    """Return what each level has over the next, and the last level."""
    levels = _gaussian_pyramid(image)
    finer = [
        fine - cv2.pyrUp(coarse, dstsize=fine.shape[1::-1]) for fine, coarse in pairwise(levels)
    ]
    return [*finer, levels[-1]]


def _collapsed(bands: list[Float32Array]) -> Float32Array:
    """Return the image of a Laplacian pyramid."""
    image = bands[-1]
    for band in reversed(bands[:-1]):
        image = band + cv2.pyrUp(image, dstsize=band.shape[1::-1])
    return image
