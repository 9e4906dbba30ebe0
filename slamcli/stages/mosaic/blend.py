"""From all views of a tile to one picture: the ways to choose between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import BoolArray, Float32Array, Int16Array, IntpArray, UInt8Array
from slamcli.stages.mosaic.sampling import Sample
from slamcli.stages.mosaic.tiles import CELL_PIXELS, MARGIN_CELLS, TILE_PIXELS

# Brightness differs slowly: it is smoothed over twice so many cells and blended over as many.
_SLOW_CELLS = 5
_UNSEEN_GRAY, _MAX_CORRECTION_GRAY = 1.0, 40.0
# Cells that differ by less than this from those around are plain floor.
_PLAIN_GRAY = 16.0
# Around a view's own cells so many more are read, for where it turns out not to see all of them.
_SPARE_CELLS = 2
_SPARE_SHARE = np.float32(1e-3)
# How much steeper than linear one view takes over from the next: within half a cell.
_STEEPNESS = 2.0
_LEVELS = 4
_BAND_MARGIN_CELLS = 8
_MEDIAN_ROWS = 64


@dataclass(frozen=True, slots=True)
class CellWindow:
    """A rectangle of a tile, in its cells; the margin's are negative or beyond the tile."""

    row: int
    column: int
    height: int
    width: int


class Reader(Protocol):
    """Reads one view of a tile at full resolution."""

    def __call__(self, place: int, window: CellWindow) -> Sample:
        """Return what the view at a place in the list shows of a window."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """All that is known of a tile before its pixels are read.

    Attributes
    ----------
    cells : (N, h, w, 3) uint8
        What each view shows of each cell, margin included.
    weights : (N, h, w) float32
        How well: pixels a metre, fading towards a picture's border; 0 where it does not see the
        cell, or shows something other than floor.
    read : Reader
    """

    cells: UInt8Array
    weights: Float32Array
    read: Reader


@dataclass(frozen=True, slots=True, eq=False)
class Blended:
    """A tile's picture.

    Attributes
    ----------
    image : (TILE_PIXELS, TILE_PIXELS, 3) uint8
    pixels_per_metre : (TILE_PIXELS, TILE_PIXELS) float32
        Pixels of a picture to a metre of floor, of the view that counted most; 0: nothing seen.
    """

    image: UInt8Array
    pixels_per_metre: Float32Array


def sharpest(weights: Float32Array) -> IntpArray:
    """Return (h, w): the view that sees each cell best, without islands; -1 where none does."""
    smooth = np.stack([np.asarray(cv2.blur(one, (3, 3)), np.float32) for one in weights])
    smooth[weights <= 0] = 0.0
    label = np.argmax(smooth, axis=0)
    return np.where((weights > 0).any(axis=0), label, -1)


def blend_best(views: Views) -> Blended:
    """Take each pixel from the view that sees it most sharply, and hide the seams.

    In two bands (after Burt & Adelson, ACM Trans. Graphics 2(4), 1983): what changes slowly, the
    brightness, passes from view to view over several cells; texture changes over within half a
    cell, so that no more of it than that is ever mixed.
    """
    label = sharpest(views.weights)
    slow = _slow_corrections(views, label)
    total = np.zeros((TILE_PIXELS, TILE_PIXELS, 3), np.float32)
    share = np.zeros((TILE_PIXELS, TILE_PIXELS), np.float32)
    pixels_per_metre = np.zeros_like(share)
    for number in np.unique(label[label >= 0]):
        own = (label == number).astype(np.float32)
        window = _window(_dilated(own, _SPARE_CELLS) > 0)
        if window is None:
            continue
        read = views.read(int(number), window)
        alpha = _takeover(own, window) * (read.weight > 0)
        part = _pixels(window)
        colour = cv2.add(read.image, _enlarged(slow[number], window), dtype=cv2.CV_32F)
        cv2.accumulateProduct(np.asarray(colour), _tripled(alpha), total[part])
        share[part] += alpha
        np.maximum(
            pixels_per_metre[part],
            read.pixels_per_metre,
            out=pixels_per_metre[part],
            where=alpha > 0,
        )
    return Blended(_divided(total, share), np.where(share > 0, pixels_per_metre, np.float32(0.0)))


def blend_mean(views: Views) -> Blended:
    """Return the plain mean of all views."""
    return _mean(views, lambda weight: (weight > 0).astype(np.float32))


def blend_feather(views: Views) -> Blended:
    """Return the mean, weighted by how sharply each view sees the pixel."""
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
            np.take_along_axis(values, np.clip(place, 0, len(values) - 1)[None, ..., None], axis=0)[
                0
            ]
            for place in ((count - 1) // 2, count // 2)
        )
        both = (low.astype(np.int32) + high + 1) // 2
        image[rows] = np.where(count[..., None] > 0, np.minimum(both, 255), 0)
    return Blended(image, pixels_per_metre.max(axis=0))


def blend_multiband(views: Views) -> Blended:
    """Return Burt and Adelson's multi-resolution spline of the views that see a spot best.

    Each octave of detail passes from view to view over its own width (ACM Trans. Graphics 2(4),
    1983); where a view sees nothing it is taken to show what the others do.
    """
    label = sharpest(views.weights)
    margin = _BAND_MARGIN_CELLS
    count = TILE_PIXELS // CELL_PIXELS + 2 * margin
    whole = CellWindow(-margin, -margin, count, count)
    chosen = [int(number) for number in np.unique(label[_inside(whole)]) if number >= 0]
    reads = [views.read(number, whole) for number in chosen]
    side = count * CELL_PIXELS
    backdrop, shares = np.zeros((side, side, 3), np.float32), []
    for number, read in zip(chosen, reads, strict=True):
        own = (label == number).astype(np.float32)
        shares.append(_takeover(own, whole) * (read.weight > 0))
    total = np.sum(shares, axis=0) if shares else np.zeros((side, side), np.float32)
    for share, read in zip(shares, reads, strict=True):
        np.divide(share, total, out=share, where=total > 0)
        backdrop += share[..., None] * read.image
    bands = [np.zeros_like(level) for level in _pyramid(backdrop)]
    sums = [np.full(band.shape[:2], 1e-6, np.float32) for band in bands]
    for share, read in zip(shares, reads, strict=True):
        filled = np.where(read.weight[..., None] > 0, read.image, backdrop).astype(np.float32)
        for depth, (detail, mask) in enumerate(zip(_details(filled), _pyramid(share), strict=True)):
            bands[depth] += detail * mask[..., None]
            sums[depth] += mask
    image = _collapsed([band / one[..., None] for band, one in zip(bands, sums, strict=True)])
    weight = np.zeros_like(total)
    for share, read in zip(shares, reads, strict=True):
        np.maximum(weight, read.pixels_per_metre, out=weight, where=share > 0)
    inner = slice(margin * CELL_PIXELS, side - margin * CELL_PIXELS)
    rounded = np.clip(np.rint(np.where(total[..., None] > 0, image, 0.0)), 0, 255)
    return Blended(rounded[inner, inner].astype(np.uint8), weight[inner, inner])


BLENDS: dict[str, Callable[[Views], Blended]] = {
    "best": blend_best,
    "feather": blend_feather,
    "multiband": blend_multiband,
    "median": blend_median,
    "mean": blend_mean,
}


def _slow_corrections(views: Views, label: IntpArray) -> dict[int, Float32Array]:
    """Return for each view that wins somewhere (h, w, 3): what blends its slow changes in.

    Slow is what a view differs by from the picture of all winners, smoothed where that is plain:
    beside an edge a difference tells of poses and blur, not of brightness.
    """
    numbers = [int(number) for number in np.unique(label[label >= 0])]
    shown = np.take_along_axis(views.cells, np.maximum(label, 0)[None, ..., None], axis=0)[0]
    around = np.ones((3, 3), np.uint8)
    span = np.asarray(cv2.morphologyEx(shown, cv2.MORPH_GRADIENT, around), np.float32).max(axis=-1)
    plain = np.where(label >= 0, 1.0 / (1.0 + (span / _PLAIN_GRAY) ** 2), 0.0).astype(np.float32)
    slow, reach = {}, {}
    total = np.zeros(shown.shape, np.float32)
    share = np.full(label.shape, 1e-6, np.float32)
    for number in numbers:
        seen = (views.weights[number] > 0).astype(np.float32)
        difference = views.cells[number].astype(np.float32) - shown
        area = _smooth(seen * plain)
        slow[number] = _smooth(difference * (seen * plain)[..., None])
        slow[number] /= np.maximum(area, np.float32(1e-3))[..., None]
        reach[number] = _smooth((label == number).astype(np.float32)) * seen
        total += reach[number][..., None] * slow[number]
        share += reach[number]
    target = total / share[..., None]
    return {number: _worthwhile(target - slow[number]) for number in numbers}


def _worthwhile(correction: NDArray[np.floating]) -> Float32Array:
    """Shrink corrections by what no eye sees, and limit them."""
    size = np.abs(correction) - np.float32(_UNSEEN_GRAY)
    limited = np.clip(size, 0.0, _MAX_CORRECTION_GRAY)
    return np.asarray(np.copysign(limited, correction), np.float32)


def _smooth(values: Float32Array) -> Float32Array:
    """Blur by a box twice, nothing beyond the border."""
    box = (_SLOW_CELLS, _SLOW_CELLS)
    once = cv2.blur(values, box, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(cv2.blur(once, box, borderType=cv2.BORDER_CONSTANT), np.float32)


def _takeover(own: Float32Array, window: CellWindow) -> Float32Array:
    """Return how much of each pixel a view claims: all of its own cells, and a trace around."""
    ramp = _enlarged(own, window)
    steep = np.clip((ramp - 0.5) * np.float32(_STEEPNESS) + 0.5, 0.0, 1.0)
    spare = _enlarged(_dilated(own, _SPARE_CELLS), window)
    claim: Float32Array = np.maximum(steep, spare * _SPARE_SHARE)
    return claim.astype(np.float32)


def _mean(views: Views, measure: Callable[[Float32Array], Float32Array]) -> Blended:
    total = np.zeros((TILE_PIXELS, TILE_PIXELS, 3), np.float32)
    share = np.zeros((TILE_PIXELS, TILE_PIXELS), np.float32)
    pixels_per_metre = np.zeros_like(share)
    for number, part, read in _reads(views):
        weight = measure(_cleared(views, number, part, read))
        colour = read.image.astype(np.float32)
        cv2.accumulateProduct(colour, _tripled(weight), total[_pixels(part)])
        share[_pixels(part)] += weight
        here = pixels_per_metre[_pixels(part)]
        np.maximum(here, read.pixels_per_metre, out=here, where=weight > 0)
    return Blended(_divided(total, share), pixels_per_metre)


def _read_all(views: Views) -> tuple[Int16Array, Float32Array]:
    found = list(_reads(views))
    images = np.zeros((max(1, len(found)), TILE_PIXELS, TILE_PIXELS, 3), np.int16)
    pixels_per_metre = np.zeros(images.shape[:3], np.float32)
    for place, (number, part, read) in enumerate(found):
        images[place][_pixels(part)] = read.image
        seen = _cleared(views, number, part, read) > 0
        pixels_per_metre[place][_pixels(part)] = np.where(
            seen, read.pixels_per_metre, np.float32(0.0)
        )
    return images, pixels_per_metre


def _reads(views: Views) -> list[tuple[int, CellWindow, Sample]]:
    """Read every view of the tile where it sees something."""
    found = []
    for number, weight in enumerate(views.weights):
        window = _window(_dilated((weight > 0).astype(np.float32), 1) > 0)
        if window is not None:
            found.append((number, window, views.read(number, window)))
    return found


def _cleared(views: Views, number: int, window: CellWindow, read: Sample) -> Float32Array:
    """Return a view's weight, 0 in the cells where it does not show the floor.

    The cells at the rim of what it sees have their centres outside, and keep it.
    """
    others = (views.weights > 0).any(axis=0) & (views.weights[number] <= 0)
    rows, columns = _inside(window)
    hidden = others[rows, columns].repeat(CELL_PIXELS, axis=0).repeat(CELL_PIXELS, axis=1)
    return np.where(hidden, np.float32(0.0), read.weight)


def _dilated(cells: Float32Array, reach: int) -> Float32Array:
    side = 2 * reach + 1
    return np.asarray(cv2.dilate(cells, np.ones((side, side), np.uint8)), np.float32)


def _window(cells: BoolArray) -> CellWindow | None:
    """Return the smallest window of the tile proper around some cells; None when none is in it."""
    inner = cells[MARGIN_CELLS:-MARGIN_CELLS, MARGIN_CELLS:-MARGIN_CELLS]
    rows, columns = np.flatnonzero(inner.any(axis=1)), np.flatnonzero(inner.any(axis=0))
    if rows.size == 0:
        return None
    return CellWindow(
        int(rows[0]),
        int(columns[0]),
        int(rows[-1] - rows[0]) + 1,
        int(columns[-1] - columns[0]) + 1,
    )


def _pixels(window: CellWindow) -> tuple[slice, slice]:
    """Return a window's place in the tile's pixels."""
    return (
        slice(window.row * CELL_PIXELS, (window.row + window.height) * CELL_PIXELS),
        slice(window.column * CELL_PIXELS, (window.column + window.width) * CELL_PIXELS),
    )


def _inside(window: CellWindow) -> tuple[slice, slice]:
    """Return a window's place in the cells."""
    row, column = window.row + MARGIN_CELLS, window.column + MARGIN_CELLS
    return slice(row, row + window.height), slice(column, column + window.width)


def _enlarged(cells: Float32Array, window: CellWindow) -> Float32Array:
    """Return a window of cells at the resolution of pixels."""
    rows, columns = _inside(window)
    # One cell more on each side, so that windows meet as if they had been enlarged in one.
    wide = cells[rows.start - 1 : rows.stop + 1, columns.start - 1 : columns.stop + 1]
    size = (wide.shape[1] * CELL_PIXELS, wide.shape[0] * CELL_PIXELS)
    large = np.asarray(cv2.resize(wide, size, interpolation=cv2.INTER_LINEAR), np.float32)
    return large[CELL_PIXELS:-CELL_PIXELS, CELL_PIXELS:-CELL_PIXELS]


def _divided(total: Float32Array, share: Float32Array) -> UInt8Array:
    divisor = np.maximum(share, np.float32(1e-9))
    return np.asarray(cv2.divide(total, _tripled(divisor), dtype=cv2.CV_8U), np.uint8)


def _tripled(plane: Float32Array) -> Float32Array:
    """Return (h, w, 3): numpy spreads over so short an axis slowly."""
    return np.asarray(cv2.merge([plane] * 3), np.float32)


def _pyramid(image: Float32Array) -> list[Float32Array]:
    levels = [image]
    for _ in range(_LEVELS):
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), np.float32))
    return levels


def _details(image: Float32Array) -> list[Float32Array]:
    """Return the Laplacian pyramid: what each level has over the next, and the last."""
    levels = _pyramid(image)
    finer = [
        fine - np.asarray(cv2.pyrUp(coarse, dstsize=fine.shape[1::-1]), np.float32)
        for fine, coarse in pairwise(levels)
    ]
    return [*finer, levels[-1]]


def _collapsed(bands: list[Float32Array]) -> Float32Array:
    image = bands[-1]
    for band in reversed(bands[:-1]):
        image = band + np.asarray(cv2.pyrUp(image, dstsize=band.shape[1::-1]), np.float32)
    return image
