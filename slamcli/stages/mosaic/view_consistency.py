"""View consistency: which views of a spot show the floor, and which show an obstacle.

An obstacle with height is displaced differently in every view (parallax), and what moves is there
in some views only. Either way it disagrees with the floor that other views show; near views count
for more.
"""

from __future__ import annotations

import cv2
import numpy as np

from slamcli.core.arrays import (
    BoolArray,
    Float32Array,
    Float64Array,
    Int16Array,
    IntpArray,
    UInt8Array,
)
from slamcli.stages.mosaic.channels import largest_channel

# All thresholds here: [guarded by benchmarks/blends.py --obstacles, tests/stages/test_mosaic.py].
# Views of one floor may differ by this much, and by this share of the brightness: noise, lamps.
_TOLERANCE_GRAY = 12.0
_TOLERANCE_SHARE = 0.08
# A greater difference is no stronger evidence (truncated distance).
_MAX_DIFFERENCE_GRAY = 48
# Two views that differ are no evidence on which one is right.
_MIN_VIEWS = 3
# Floor continues across the border of the region where views differ; an obstacle ends there. Both
# sides are compared over this many cells; the obstacle is the view that differs by this many gray
# levels more, and this many times as much, as the least differing view does.
_OUTLINE_CELLS = 4
_OUTLINE_GRAY, _OUTLINE_RATIO = 8.0, 1.5
_MIN_OUTLINE_CELLS = 6


def reference(cells: UInt8Array, weights: Float32Array) -> tuple[UInt8Array, IntpArray]:
    """Return the weighted medoid of the views of every cell, and which view it is.

    Under a truncated distance: the view that is nearest to all others, each by its weight. Unlike
    a mean or median it is one that was really seen, and it follows the largest cluster (a truncated
    estimator; Huber & Ronchetti, Robust Statistics, 2009, ch. 4).

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
            largest = largest_channel(channels)
            distance = np.minimum(largest.astype(np.float32), greatest)
            cost[first] += distance * weights[second]
            cost[second] += distance * weights[first]
    # A view that does not see the cell is never chosen; the only one that does always is.
    cost[weights <= 0] = np.inf
    chosen = np.argmin(cost, axis=0)
    picked = np.take_along_axis(cells, chosen[None, ..., None], axis=0)[0]
    return picked, chosen


def floor_views(cells: UInt8Array, weights: Float32Array, reach_cells: int = 1) -> BoolArray:
    """Return (N, h, w): whether a view shows, in a cell that it sees, the floor.

    A value between the lowest and the highest of the reference around a cell agrees with it, as
    errors of poses and blur displace edges. Where two thirds of three views or more agree, that is
    decided. Elsewhere the obstacle is in the view whose content ends where the views begin to
    differ, while another's floor continues (as abandoned objects are distinguished from removed
    ones: San Miguel and Martinez, AVSS 2008). Where the outline does not decide, the decisions on
    the neighbouring cells of the same connected part do: a leg that was recognised near the robot
    is one as far as it reaches. What stays undecided goes to the view of higher resolution. Where
    no view is left, the one nearest to the reference is kept.

    Parameters
    ----------
    cells : (N, h, w, 3) uint8
    weights : (N, h, w) float32
        0 where a view does not see a cell.
    reach_cells : int
        How far around a cell the reference may show the same: by this much poses may be wrong.
    """
    agrees = weights > 0
    part = _inconsistent(cells, agrees, reach_cells + 1 + _OUTLINE_CELLS)
    if part is not None:
        agrees[:, *part] = _floor_views_of(cells[:, *part], weights[:, *part], reach_cells)
    return agrees


def _inconsistent(cells: UInt8Array, seen: BoolArray, margin: int) -> tuple[slice, slice] | None:
    """Return the window, with a margin, around all cells in which views differ; None for none."""
    count = seen.sum(axis=0)
    high = np.where(seen[..., None], cells, np.uint8(0)).max(axis=0)
    low = np.where(seen[..., None], cells, np.uint8(255)).min(axis=0)
    spread = largest_channel(high.astype(np.int16) - low)
    differ = (spread > _TOLERANCE_GRAY) & (count > 1)
    if not differ.any():
        return None
    rows, columns = np.flatnonzero(differ.any(axis=1)), np.flatnonzero(differ.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
    )


def _floor_views_of(cells: UInt8Array, weights: Float32Array, reach_cells: int) -> BoolArray:
    """Return what `floor_views` does, without its short cut for cells that views agree on."""
    seen = weights > 0
    count = seen.sum(axis=0)
    shown, _ = reference(cells, weights)
    outside = beyond(cells, shown, count == 0, reach_cells)
    leaves = seen & (outside > 0)
    if not leaves.any():
        return seen
    other = seen & (beyond(cells, shown, count == 0, 0) > 0)
    differs = np.zeros_like(seen)
    for number in np.flatnonzero(leaves.any(axis=(1, 2))):
        differs[number] = _grown(leaves[number], other[number], seen[number], reach_cells)
    contested = np.asarray(differs.any(axis=0))
    if not contested.any():
        return seen
    wrong = (other | differs).sum(axis=0)
    decided = (count >= _MIN_VIEWS) & (3 * wrong <= count)
    open_cells = contested & ~decided
    open_cells &= ~_decide_by_outline(cells, seen, differs, open_cells, ~contested)
    votes = np.zeros(count.shape)
    for view, sees in zip(differs, seen, strict=True):
        undecided = open_cells & sees
        if undecided.any():
            for_floor = contested & decided & sees & ~view
            vote = _vote(undecided, for_floor, decided & view)
            # Evidence against one view is evidence for those that differ from it.
            votes += np.where(view, vote, -vote)
    differs ^= seen & open_cells & (votes < 0)
    differs &= ~(open_cells & (votes == 0) & (count < _MIN_VIEWS))
    agrees: BoolArray = seen & ~differs
    orphaned = (count > 0) & ~agrees.any(axis=0)
    if orphaned.any():
        nearest = np.argmin(np.where(seen, outside, np.int16(1000)), axis=0)
        rows, columns = np.nonzero(orphaned)
        agrees[nearest[rows, columns], rows, columns] = True
    return agrees


def beyond(
    cells: UInt8Array,
    shown: UInt8Array,
    blank: BoolArray,
    reach_cells: int,
) -> Int16Array:
    """Return (..., h, w): by how many gray levels views leave what an image shows about a cell.

    Parameters
    ----------
    cells : (..., h, w, 3) uint8
    shown : (h, w, 3) uint8
    blank : (h, w) bool
        Where the image shows nothing.
    reach_cells : int
        How far about a cell.
    """
    around = np.ones((2 * reach_cells + 1, 2 * reach_cells + 1), np.uint8)
    nothing = blank[..., None]
    low = np.asarray(cv2.erode(np.where(nothing, np.uint8(255), shown), around), np.int16)
    high = np.asarray(cv2.dilate(np.where(nothing, np.uint8(0), shown), around), np.int16)
    slack = np.int16(_TOLERANCE_GRAY) + (_TOLERANCE_SHARE * high.max(axis=-1)).astype(np.int16)
    values = cells.astype(np.int16)
    return np.asarray(largest_channel(np.maximum(low - values, values - high)) - slack, np.int16)


def _vote(undecided: BoolArray, for_floor: BoolArray, against: BoolArray) -> Float64Array:
    """Return (h, w): 1 where an undecided part of one view is not floor, -1 where it is, else 0.

    By the majority of the decided cells that border on each connected part: of those where the view
    shows the floor (`for_floor`), and where it does not (`against`).
    """
    number, labels = cv2.connectedComponents(undecided.astype(np.uint8), connectivity=4)
    around = np.ones((3, 3), np.uint8)
    votes = np.zeros(number)
    for cells, vote in ((for_floor, -1.0), (against, 1.0)):
        touched = cv2.dilate(cells.astype(np.uint8), around) > 0
        votes += vote * np.bincount(labels[touched & undecided], minlength=number)
    return np.where(undecided, np.sign(votes)[labels], 0.0)


def _decide_by_outline(
    cells: UInt8Array,
    seen: BoolArray,
    differs: BoolArray,
    open_cells: BoolArray,
    agreed: BoolArray,
) -> BoolArray:
    """Set `differs` by the outline of each connected part of `open_cells`; return where it did.

    A view whose content continues from the agreed floor around the part shows floor.
    """
    decided = np.zeros_like(open_cells)
    number, labels, boxes, _ = cv2.connectedComponentsWithStats(open_cells.astype(np.uint8))
    for label in range(1, number):
        left, top, width, height = (int(value) for value in boxes[label][:4])
        rows = slice(max(0, top - _OUTLINE_CELLS), top + height + _OUTLINE_CELLS)
        columns = slice(max(0, left - _OUTLINE_CELLS), left + width + _OUTLINE_CELLS)
        part = labels[rows, columns] == label
        steps = np.array(
            [
                _step_at_outline(
                    view[rows, columns], sees[rows, columns], part, agreed[rows, columns]
                )
                for view, sees in zip(cells, seen, strict=True)
            ]
        )
        known = np.isfinite(steps)
        if np.count_nonzero(known) < 2:
            continue
        least = float(np.nanmin(steps))
        obstacle = steps > max(_OUTLINE_RATIO * least, least + _OUTLINE_GRAY)
        if obstacle.any():
            where = known[:, None, None] & part & seen[:, rows, columns]
            np.copyto(differs[:, rows, columns], obstacle[:, None, None], where=where)
            decided[rows, columns] |= part
    return decided


def _step_at_outline(
    view: UInt8Array,
    sees: BoolArray,
    part: BoolArray,
    agreed: BoolArray,
) -> float:
    """Return the step in gray levels from what a view shows beside a part to what it shows in it.

    nan where the view does not see enough of both.
    """
    beside = agreed & sees
    around = np.ones((2 * _OUTLINE_CELLS + 1, 2 * _OUTLINE_CELLS + 1), np.uint8)
    near = cv2.dilate(beside.astype(np.uint8), around) > 0
    compared = part & sees & near
    if np.count_nonzero(compared) < _MIN_OUTLINE_CELLS:
        return float("nan")
    outside = beyond(view, view, ~beside, _OUTLINE_CELLS)[compared]
    return float(np.clip(outside, 0, _MAX_DIFFERENCE_GRAY).mean())


def _grown(
    leaves: BoolArray,
    other: BoolArray,
    seen: BoolArray,
    reach_cells: int,
) -> BoolArray:
    """Drop what is at most two cells wide, edges displaced by errors of poses; grow the rest.

    An obstacle's outline is mixed with floor, and as far inside of it as edges may be displaced the
    reference agrees with both. What continues beyond the view's border is not thin.

    Parameters
    ----------
    leaves, other : (h, w) bool
        Where the view differs from what the reference shows about a cell; and from the cell alone.
    seen : (h, w) bool
    reach_cells : int
    """
    around = np.ones((3, 3), np.uint8)
    wide = cv2.morphologyEx((leaves | ~seen).astype(np.uint8), cv2.MORPH_OPEN, around)
    solid = np.where(leaves, wide, np.uint8(0))
    outline = cv2.dilate(solid, around, iterations=reach_cells + 1) > 0
    grown: BoolArray = (cv2.dilate(solid, around) > 0) | (outline & other)
    return grown & seen
