"""Occupancy: where floor is confirmed, where something stands on it, and where neither is known.

A cell is free only where views from places far enough apart agree on what it shows: something that
stands there would be displaced between them (parallax). A thing whose sides are plain looks the
same in all of them next to its foot, as floor does; but it lacks the floor's texture, it has
another colour, and behind it the views differ. A plain part of a colour that the floor has nowhere
else is therefore occupied when views differ beside it, and a painted mark when they do not. Where
that cannot be seen, as the part goes on beyond what was seen, or all views of it are from one
place, it is occupied, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, Float64Array, Int32Array, UInt8Array
from slamcli.core.records import FloorEvidence
from slamcli.stages.mosaic import view_consistency

# All thresholds here: [guarded by benchmarks/nav2.py].
# What is this high must be displaced by this many cells between the views that agree; of a camera
# whose height has no metres, a share of it.
MIN_HEIGHT_METRES, _MIN_HEIGHT_SHARE, _DISPLACED_CELLS = 0.04, 0.13, 2.0
# Views may differ by what lies this far apart: errors of poses.
_REACH_CELLS = 1
# Plain is what has this share of the floor's typical texture, or no more than a camera's noise.
_PLAIN_SHARE, _PLAIN_GRAY = 0.45, 1.5
# Most of the cells around one that is confirmed by its texture have texture.
_TEXTURE_CELLS, _TEXTURE_SHARE = 5, 0.6
# Plain parts this near to each other are faces of one thing; so many cells of it, and so many of
# those where views differ, make it one. Fewer such cells together are noise.
_FACES_CELLS, _MIN_PART_CELLS, _MIN_CELLS, _MIN_DIFFERING_CELLS = 2, 3, 6, 3
# A part of which more than this share is open is not known to be flat.
_UNCONFIRMED_SHARE = 0.05
# Colours are counted in steps of so many gray levels; one is foreign to the floor when it, and
# those beside it, make less than this share.
_COLOUR_STEP, _FOREIGN_SHARE = 8, 0.01
# A plain part is floor when the robot drove over it, or when it is this share of all that was seen.
_FLOOR_SHARE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Occupancy:
    """The state of cells: (h, w) bool each; what is neither is unknown."""

    free: BoolArray
    occupied: BoolArray


def floor_evidence(
    cells: UInt8Array, weights: Float32Array, positions: Float64Array
) -> FloorEvidence:
    """Return what the views of some cells say about their being floor.

    Parameters
    ----------
    cells : (N, h, w, 3) uint8
    weights : (N, h, w) float32
        0 where a view does not see a cell.
    positions : (N, 2) float64
        Of the floor below each view's camera, metres.
    """
    seen = weights > 0
    hidden = np.asarray(~seen.any(axis=0), np.bool_)
    shown, _ = view_consistency.reference(cells, weights)
    differs = seen & (view_consistency.beyond(cells, shown, hidden, _REACH_CELLS) > 0)
    baseline = _extent(seen & ~differs, positions)
    baseline[hidden] = -1.0
    gray = np.asarray(cv2.cvtColor(shown, cv2.COLOR_BGR2GRAY), np.float32)
    mean = cv2.blur(gray, (3, 3))
    texture = np.sqrt(np.maximum(cv2.blur(gray * gray, (3, 3)) - mean * mean, 0.0))
    texture[_dilated(hidden, 1)] = np.nan
    return FloorEvidence(baseline, np.asarray(texture, np.float32), np.asarray(differs.any(axis=0)))


def _extent(agree: BoolArray, positions: Float64Array) -> Float32Array:
    """Return (h, w): how far the views that agree are apart, in the widest of four directions."""
    widest = np.zeros(agree.shape[1:], np.float32)
    for angle in np.arange(4) * np.pi / 4:
        along = (positions @ (np.cos(angle), np.sin(angle))).astype(np.float32)[:, None, None]
        low = np.where(agree, along, np.float32(np.inf)).min(axis=0)
        high = np.where(agree, along, np.float32(-np.inf)).max(axis=0)
        widest = np.maximum(widest, np.where(high >= low, high - low, np.float32(0.0)))
    return np.asarray(widest, np.float32)


def min_baseline(cell_metres: float, height_metres: float, *, metric: bool) -> float:
    """Return how far apart views must be that betray the lowest thing that matters.

    Parameters
    ----------
    cell_metres : float
        Side of a cell.
    height_metres : float
        Of the camera.
    metric : bool
        Whether lengths are metres.
    """
    lowest = MIN_HEIGHT_METRES / height_metres if metric else _MIN_HEIGHT_SHARE
    lowest = min(lowest, 0.5)
    return _DISPLACED_CELLS * cell_metres * (1.0 - lowest) / lowest


def plain_below(textures: Float32Array) -> float:
    """Return the texture below which a cell is plain, from the textures of the map's cells."""
    known = textures[np.isfinite(textures)]
    return max(_PLAIN_GRAY, _PLAIN_SHARE * float(np.median(known))) if known.size else _PLAIN_GRAY


def classify(
    evidence: FloorEvidence,
    colours: UInt8Array,
    driven: BoolArray,
    plain_gray: float,
    baseline_metres: float,
) -> Occupancy:
    """Return which cells are free and which are occupied.

    Parameters
    ----------
    evidence : FloorEvidence
    colours : (h, w, 3) uint8
        Of the map.
    driven : (h, w) bool
        Cells that the robot's origin passed: floor, unless views differ there.
    plain_gray : float
        From `plain_below`.
    baseline_metres : float
        From `min_baseline`.
    """
    inside = np.isfinite(evidence.texture_gray)
    plain = inside & (np.nan_to_num(evidence.texture_gray, nan=np.inf) < plain_gray)
    textured = inside & (_mean(inside & ~plain, _TEXTURE_CELLS) > _TEXTURE_SHARE)
    beside = _dilated(_together(evidence.differs), 2)
    parts = _PlainParts(plain, driven, inside, beside)
    unconfirmed = _dilated(~inside, 2) | (evidence.baseline_metres < baseline_metres)
    things, doubtful = parts.things(colours, unconfirmed)
    plain_floor = parts.labels > 0
    plain_floor &= ~things & ~doubtful & parts.large
    # Edges between a thing's faces, and its outline, are not plain.
    rest = (evidence.baseline_metres >= 0) & ~textured & ~plain_floor
    occupied = (_dilated(things, 3) & rest) | _dilated(things, 1)
    closed = cv2.morphologyEx(occupied.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    occupied = closed > 0
    free = (textured | plain_floor) & (evidence.baseline_metres >= baseline_metres)
    free &= ~_dilated(occupied, 1) & ~doubtful
    return Occupancy(np.asarray(free, np.bool_), np.asarray(occupied, np.bool_))


def outlines(occupied: BoolArray) -> list[Int32Array]:
    """Return the (N, 2) corners, columns and rows of cells, of each connected part's outline."""
    doubled = occupied.astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)
    contours, _ = cv2.findContours(doubled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    # The outermost pixels of a doubled picture lie half a cell inside of the cells' own border.
    corners = [np.asarray((contour[:, 0] + 1) // 2, np.int32) for contour in contours]
    return [ring[np.any(ring != np.roll(ring, 1, axis=0), axis=1)] for ring in corners]


def signed_area(corners: Float64Array) -> float:
    """Return the area of (N, 2) corners, positive when they go round counter-clockwise."""
    following = np.roll(corners, -1, axis=0)
    return 0.5 * float(np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]))


class _PlainParts:
    """Connected plain cells.

    Attributes
    ----------
    labels : (h, w) int32
        0 where a cell is not plain.
    floor : (h, w) bool
        Parts that are floor by their size, or as the robot drove over them and no views differ
        beside them.
    large : (h, w) bool
        Parts of more than a few cells.

    Parameters
    ----------
    plain, driven, inside : (h, w) bool
    beside : (h, w) bool
        Cells next to those where views differ.
    """

    def __init__(
        self, plain: BoolArray, driven: BoolArray, inside: BoolArray, beside: BoolArray
    ) -> None:
        self.number, labels, boxes, _ = cv2.connectedComponentsWithStats(
            plain.astype(np.uint8), connectivity=4
        )
        self.labels = np.asarray(labels, np.int32)
        self._inside = inside
        self._beside = beside
        self._area = np.asarray(boxes[:, cv2.CC_STAT_AREA])
        floor = self._area > _FLOOR_SHARE * np.count_nonzero(inside)
        contested = np.bincount(labels[beside], minlength=self.number) >= _MIN_DIFFERING_CELLS
        floor |= (np.bincount(labels[driven], minlength=self.number) > 0) & ~contested
        floor[0] = False
        self.floor = np.asarray(floor[labels])
        large = self._area >= _MIN_PART_CELLS
        large[0] = False
        self.large = np.asarray(large[labels])

    def things(self, colours: UInt8Array, unconfirmed: BoolArray) -> tuple[BoolArray, BoolArray]:
        """Return the parts that are things, and those of the floor's colours that may be.

        Parameters
        ----------
        colours : (h, w, 3) uint8
        unconfirmed : (h, w) bool
            Cells about which views could not differ, if something stood there.
        """
        beside = self._beside
        candidates = self.large & ~self.floor
        foreign = candidates & self._foreign(colours, candidates & beside)
        near = _dilated(foreign, _FACES_CELLS)
        number, labels = cv2.connectedComponents(near.astype(np.uint8))
        labels[~foreign] = 0
        size = np.bincount(labels[foreign], minlength=number)
        touching = np.bincount(labels[foreign & beside], minlength=number)
        unknown = np.bincount(labels[foreign & unconfirmed], minlength=number)
        thing = (touching >= _MIN_DIFFERING_CELLS) | (unknown > _UNCONFIRMED_SHARE * size)
        thing &= size >= _MIN_CELLS
        thing[0] = False
        return np.asarray(thing[labels]), candidates & ~foreign & beside

    def _foreign(self, colours: UInt8Array, suspects: BoolArray) -> BoolArray:
        """Return the parts whose mean colour is rare on the floor: not in suspects, nor beside."""
        suspected = np.bincount(self.labels[suspects], minlength=self.number) > 0
        suspected[0] = False
        others = colours[self._inside & ~self._beside & ~suspected[self.labels]] // _COLOUR_STEP
        count = 256 // _COLOUR_STEP + 2
        histogram = np.zeros((count,) * 3)
        np.add.at(histogram, tuple(1 + others.T.astype(np.intp)), 1.0)
        steps = range(-1, 2)
        shifts = [(a, b, c) for a in steps for b in steps for c in steps]
        around = sum(np.roll(histogram, shift, (0, 1, 2)) for shift in shifts)
        flat = self.labels.ravel()
        sums = [np.bincount(flat, c.ravel(), self.number) for c in np.moveaxis(colours, 2, 0)]
        mean = np.stack(sums, axis=1) / np.maximum(self._area, 1)[:, None]
        places = tuple(1 + (mean // _COLOUR_STEP).astype(np.intp).T)
        # A part is no evidence of its own colour being the floor's.
        elsewhere = np.asarray(around)[places] - np.where(suspected, 0, self._area)
        foreign = elsewhere < _FOREIGN_SHARE * histogram.sum()
        return np.asarray(foreign[self.labels], np.bool_)


def _together(differs: BoolArray) -> BoolArray:
    """Return the cells that differ together with some beside them."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(differs.astype(np.uint8))
    together = boxes[:, cv2.CC_STAT_AREA] > _MIN_DIFFERING_CELLS
    together[0] = False
    return np.asarray(together[labels], np.bool_)


def _dilated(cells: BoolArray, count: int) -> BoolArray:
    around = np.ones((2 * count + 1, 2 * count + 1), np.uint8)
    return np.asarray(cv2.dilate(cells.astype(np.uint8), around) > 0, np.bool_)


def _mean(cells: BoolArray, side: int) -> Float32Array:
    return np.asarray(cv2.blur(cells.astype(np.float32), (side, side)), np.float32)
