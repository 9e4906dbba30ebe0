"""Which views of a spot show the floor: those that the others, the near ones first, agree with.

What stands on the floor leans away from the camera and looks different from everywhere; what moves
is there for some views only. Either way it disagrees with the floor that other views show.
"""

from __future__ import annotations

from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from slamcli.core.arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int16Array,
    IntpArray,
    UInt8Array,
)

Channel = TypeVar("Channel", np.uint8, np.int16)

# So much, and so large a share of the brightness, may views of one floor differ by: noise, lamps.
_TOLERANCE_GRAY = 12.0
_TOLERANCE_SHARE = 0.08
# A difference beyond this tells no more.
_MAX_DIFFERENCE_GRAY = 48
# Two views that differ do not tell which one is right.
_MIN_VIEWS = 3
# Floor goes on across the border of where views differ; a thing ends there. So far, in cells, to
# either side they are compared, and by so much more, and so many times, must it differ.
_OUTLINE_CELLS = 4
_OUTLINE_GRAY, _OUTLINE_TIMES = 8.0, 1.5
_MIN_OUTLINE_CELLS = 6


def reference(cells: UInt8Array, weights: Float32Array) -> tuple[UInt8Array, IntpArray]:
    """Return what most of the weight shows of every cell, and which view shows it.

    The weighted medoid under a truncated distance: the view that is nearest to all others, those
    counted by their weights. Unlike a mean or median it is one that was really seen, and follows
    the largest cluster (a truncated estimator; Huber & Ronchetti, Robust Statistics, 2009, ch. 4).

    Parameters
    ----------
    cells : (N, h, w, 3) uint8
    weights : (N, h, w) float32
        0 where a view does not see a cell.
    """
    count = len(cells)
    cost = np.zeros(weights.shape, np.float32)
    greatest = np.float32(_MAX_DIFFERENCE_GRAY)
    for first in range(count):
        for second in range(first + 1, count):
            channels = cv2.absdiff(cells[first], cells[second])
            largest = _largest(np.asarray(channels, np.uint8))
            distance = np.minimum(largest.astype(np.float32), greatest)
            cost[first] += distance * weights[second]
            cost[second] += distance * weights[first]
        # A view that does not see the cell must not win; one on its own still does.
    cost[weights <= 0] = np.inf
    chosen = np.argmin(cost, axis=0)
    picked = np.take_along_axis(cells, chosen[None, ..., None], axis=0)[0]
    return picked, chosen


def floor_views(cells: UInt8Array, weights: Float32Array, reach_cells: int = 1) -> BoolArray:
    """Return (N, h, w): whether a view shows, in a cell that it sees, the floor.

    A value between the lowest and the highest of the reference around a cell agrees with it: so
    much do poses and blur displace an edge. Where two thirds of three views or more agree, that is
    decided. Elsewhere the thing is in the view that ends where the views begin to differ, while
    another's floor goes on (as what was left behind is told from what was taken away: San Miguel
    and Martinez, AVSS 2008). Where that does not tell, a view is believed as it is where its own
    picture goes on: a leg that is found out near the robot is one as far as it reaches. What stays
    undecided goes to the sharper view. Where no view is left, the nearest to the reference is.

    Parameters
    ----------
    cells : (N, h, w, 3) uint8
    weights : (N, h, w) float32
        0 where a view does not see a cell.
    reach_cells : int
        How far around a cell the reference may show the same: by so much poses are wrong.
    """
    agrees = weights > 0
    part = _doubtful(cells, agrees, reach_cells + 1 + _OUTLINE_CELLS)
    if part is not None:
        agrees[:, *part] = _agreeing(cells[:, *part], weights[:, *part], reach_cells)
    return agrees


def _doubtful(cells: UInt8Array, seen: BoolArray, margin: int) -> tuple[slice, slice] | None:
    """Return the window around all cells that views show too differently."""
    count = seen.sum(axis=0)
    high = np.where(seen[..., None], cells, np.uint8(0)).max(axis=0)
    low = np.where(seen[..., None], cells, np.uint8(255)).min(axis=0)
    spread = _largest(high.astype(np.int16) - low)
    differ = (spread > _TOLERANCE_GRAY) & (count > 1)
    if not differ.any():
        return None
    rows, columns = np.flatnonzero(differ.any(axis=1)), np.flatnonzero(differ.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
    )


def _agreeing(cells: UInt8Array, weights: Float32Array, reach_cells: int) -> BoolArray:
    seen = weights > 0
    count = seen.sum(axis=0)
    shown, _ = reference(cells, weights)
    beyond = _beyond(cells, shown, count == 0, reach_cells)
    leaves = seen & (beyond > 0)
    if not leaves.any():
        return seen
    other = seen & (_beyond(cells, shown, count == 0, 0) > 0)
    differs = np.zeros_like(seen)
    for number in np.flatnonzero(leaves.any(axis=(1, 2))):
        differs[number] = _grown(leaves[number], other[number], seen[number], reach_cells)
    contested = np.asarray(differs.any(axis=0))
    if not contested.any():
        return seen
    wrong = (other | differs).sum(axis=0)
    decided = (count >= _MIN_VIEWS) & (3 * wrong <= count)
    open_cells = contested & ~decided
    told = _settle_by_outline(cells, seen, differs, open_cells, ~contested)
    open_cells = open_cells & ~told
    votes = np.zeros(count.shape)
    for view, sees in zip(differs, seen, strict=True):
        undecided = open_cells & sees
        if undecided.any():
            for_floor = contested & decided & sees & ~view
            vote = _vote(undecided, for_floor, decided & view)
            # To find out one view is to clear those that differ from it.
            votes += np.where(view, vote, -vote)
    differs ^= seen & open_cells & (votes < 0)
    differs &= ~(open_cells & (votes == 0) & (count < _MIN_VIEWS))
    agrees: BoolArray = seen & ~differs
    orphaned = (count > 0) & ~agrees.any(axis=0)
    if orphaned.any():
        nearest = np.argmin(np.where(seen, beyond, np.int16(1000)), axis=0)
        rows, columns = np.nonzero(orphaned)
        agrees[nearest[rows, columns], rows, columns] = True
    return agrees


def _beyond(
    cells: UInt8Array,
    shown: UInt8Array,
    blank: BoolArray,
    reach_cells: int,
) -> Int16Array:
    """Return (..., h, w): by how many gray levels views leave what a picture shows about a cell.

    Parameters
    ----------
    cells : (..., h, w, 3) uint8
    shown : (h, w, 3) uint8
    blank : (h, w) bool
        Where the picture shows nothing.
    reach_cells : int
        How far about a cell.
    """
    around = np.ones((2 * reach_cells + 1, 2 * reach_cells + 1), np.uint8)
    nothing = blank[..., None]
    low = np.asarray(cv2.erode(np.where(nothing, np.uint8(255), shown), around), np.int16)
    high = np.asarray(cv2.dilate(np.where(nothing, np.uint8(0), shown), around), np.int16)
    slack = np.int16(_TOLERANCE_GRAY) + (_TOLERANCE_SHARE * high.max(axis=-1)).astype(np.int16)
    values = cells.astype(np.int16)
    return np.asarray(_largest(np.maximum(low - values, values - high)) - slack, np.int16)


def _vote(undecided: BoolArray, for_floor: BoolArray, against: BoolArray) -> Float64Array:
    """Return 1 where an undecided part of one view is none of the floor, -1 where it is, else 0.

    By whether the connected part borders more on cells where the view was found to show the floor,
    or not.
    """
    number, labels = cv2.connectedComponents(undecided.astype(np.uint8), connectivity=4)
    around = np.ones((3, 3), np.uint8)
    votes = np.zeros(number)
    for cells, vote in ((for_floor, -1.0), (against, 1.0)):
        touched = np.asarray(cv2.dilate(cells.astype(np.uint8), around)) > 0
        votes += vote * np.bincount(np.asarray(labels)[touched & undecided], minlength=number)
    return np.where(undecided, np.sign(votes)[labels], 0.0)


def _settle_by_outline(
    cells: UInt8Array,
    seen: BoolArray,
    differs: BoolArray,
    open_cells: BoolArray,
    agreed: BoolArray,
) -> BoolArray:
    """Decide, in the caller's own array, where views stand against others; return where it did.

    A connected part at a time: what goes on from the floor around it, over which no views differ,
    is floor.
    """
    settled = np.zeros_like(open_cells)
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(open_cells.astype(np.uint8))
    for label in range(1, number):
        left, top, width, height = (int(value) for value in boxes[label][:4])
        rows = slice(max(0, top - _OUTLINE_CELLS), top + height + _OUTLINE_CELLS)
        columns = slice(max(0, left - _OUTLINE_CELLS), left + width + _OUTLINE_CELLS)
        part = np.asarray(labels)[rows, columns] == label
        off = np.array(
            [
                _off_surroundings(
                    view[rows, columns], sees[rows, columns], part, agreed[rows, columns]
                )
                for view, sees in zip(cells, seen, strict=True)
            ]
        )
        known = np.isfinite(off)
        if np.count_nonzero(known) < 2:
            continue
        least = float(np.nanmin(off))
        things = off > max(_OUTLINE_TIMES * least, least + _OUTLINE_GRAY)
        if things.any():
            told = known[:, None, None] & part & seen[:, rows, columns]
            np.copyto(differs[:, rows, columns], things[:, None, None], where=told)
            settled[rows, columns] |= part
    return settled


def _off_surroundings(
    view: UInt8Array,
    sees: BoolArray,
    part: BoolArray,
    agreed: BoolArray,
) -> float:
    """Return by how many gray levels a view's part leaves what it shows beside it.

    nan where the view does not see enough of both.
    """
    beside = agreed & sees
    around = np.ones((2 * _OUTLINE_CELLS + 1, 2 * _OUTLINE_CELLS + 1), np.uint8)
    near = np.asarray(cv2.dilate(beside.astype(np.uint8), around)) > 0
    compared = part & sees & near
    if np.count_nonzero(compared) < _MIN_OUTLINE_CELLS:
        return float("nan")
    beyond = _beyond(view, view, ~beside, _OUTLINE_CELLS)[compared]
    return float(np.clip(beyond, 0, _MAX_DIFFERENCE_GRAY).mean())


def _largest(channels: NDArray[Channel]) -> NDArray[Channel]:
    """Return the largest of three channels; numpy's maximum over so short an axis is slow."""
    return np.asarray(
        np.maximum(np.maximum(channels[..., 0], channels[..., 1]), channels[..., 2]), channels.dtype
    )


def _grown(
    leaves: BoolArray,
    other: BoolArray,
    seen: BoolArray,
    reach_cells: int,
) -> BoolArray:
    """Drop what is at most two cells wide, which are edges that poses displace; grow the rest.

    A thing's outline is mixed with floor, and as far inside of it as edges may be displaced the
    reference allows both. What goes on beyond the view's border is not thin.

    Parameters
    ----------
    leaves, other : (h, w) bool
        Where the view leaves what the reference shows about a cell; and what it shows in it.
    seen : (h, w) bool
    reach_cells : int
    """
    around = np.ones((3, 3), np.uint8)
    wide = cv2.morphologyEx((leaves | ~seen).astype(np.uint8), cv2.MORPH_OPEN, around)
    solid = np.where(leaves, np.asarray(wide), np.uint8(0))
    outline = np.asarray(cv2.dilate(solid, around, iterations=reach_cells + 1)) > 0
    grown: BoolArray = (np.asarray(cv2.dilate(solid, around)) > 0) | (outline & other)
    return grown & seen
