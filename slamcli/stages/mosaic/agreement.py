"""Which views of a spot show the floor: those that the others, the near ones first, agree with.

What stands on the floor leans away from the camera and looks different from everywhere; what moves
is there for some views only. Either way it disagrees with the floor that other views show.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Channel = TypeVar("Channel", np.uint8, np.int16)

# So much, and so large a share of the brightness, may views of one floor differ by: noise, lamps.
_TOLERANCE_GRAY = 12.0
_TOLERANCE_SHARE = 0.08
# A difference beyond this tells no more.
_GREATEST_DIFFERENCE_GRAY = 48
# Two views that differ do not tell which one is right.
_LEAST_VIEWS = 3


def reference(
    cells: NDArray[np.uint8], weights: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
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
    greatest = np.float32(_GREATEST_DIFFERENCE_GRAY)
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


def agreeing(
    cells: NDArray[np.uint8], weights: NDArray[np.float32], reach_cells: int = 1
) -> NDArray[np.bool_]:
    """Return (N, h, w): whether a view shows, in a cell that it sees, the floor.

    A value between the lowest and the highest of the reference around a cell agrees with it: so
    much do poses and blur displace an edge. Where two thirds of three views or more agree, that is
    decided; elsewhere a view is believed as it is where its own picture goes on: a leg that is
    found out near the robot is one as far as it reaches. What stays undecided goes to the sharper
    view. Where no view is left, the nearest to the reference is.

    Parameters
    ----------
    cells : (N, h, w, 3) uint8
    weights : (N, h, w) float32
        0 where a view does not see a cell.
    reach_cells : int
        How far around a cell the reference may show the same: by so much poses are wrong.
    """
    agrees = weights > 0
    part = _doubtful(cells, agrees, reach_cells + 2)
    if part is not None:
        agrees[:, *part] = _agreeing(cells[:, *part], weights[:, *part], reach_cells)
    return agrees


def _doubtful(
    cells: NDArray[np.uint8], seen: NDArray[np.bool_], margin: int
) -> tuple[slice, slice] | None:
    """Return the window around all cells that three views or more show too differently."""
    count = seen.sum(axis=0)
    high = np.where(seen[..., None], cells, np.uint8(0)).max(axis=0)
    low = np.where(seen[..., None], cells, np.uint8(255)).min(axis=0)
    spread = _largest(high.astype(np.int16) - low)
    differ = (spread > _TOLERANCE_GRAY) & (count > 1)
    if not (differ & (count >= _LEAST_VIEWS)).any():
        return None
    rows, columns = np.flatnonzero(differ.any(axis=1)), np.flatnonzero(differ.any(axis=0))
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
    )


def _agreeing(
    cells: NDArray[np.uint8], weights: NDArray[np.float32], reach_cells: int
) -> NDArray[np.bool_]:
    seen = weights > 0
    count = seen.sum(axis=0)
    beyond = _beyond(cells, weights, count, reach_cells)
    differs = seen & (beyond > 0)
    for number in np.flatnonzero(differs.any(axis=(1, 2))):
        differs[number] = _grown(differs[number]) & seen[number]
    wrong = differs.sum(axis=0)
    if not wrong.any():
        return seen
    contested = wrong > 0
    decided = (count >= _LEAST_VIEWS) & (3 * wrong <= count)
    open_cells = contested & ~decided
    for view, sees in zip(differs, seen, strict=True):
        undecided = open_cells & sees
        if undecided.any():
            for_floor = contested & decided & sees & ~view
            _settle(view, undecided, for_floor, decided & view)
    agrees: NDArray[np.bool_] = seen & ~differs
    orphaned = (count > 0) & ~agrees.any(axis=0)
    if orphaned.any():
        nearest = np.argmin(np.where(seen, beyond, np.int16(1000)), axis=0)
        rows, columns = np.nonzero(orphaned)
        agrees[nearest[rows, columns], rows, columns] = True
    return agrees


def _beyond(
    cells: NDArray[np.uint8],
    weights: NDArray[np.float32],
    count: NDArray[np.intp],
    reach_cells: int,
) -> NDArray[np.int16]:
    """Return (N, h, w): by how many gray levels each view leaves what the reference allows."""
    shown, _ = reference(cells, weights)
    around = np.ones((2 * reach_cells + 1, 2 * reach_cells + 1), np.uint8)
    nothing = (count == 0)[..., None]
    low = np.asarray(cv2.erode(np.where(nothing, np.uint8(255), shown), around), np.int16)
    high = np.asarray(cv2.dilate(np.where(nothing, np.uint8(0), shown), around), np.int16)
    slack = np.int16(_TOLERANCE_GRAY) + (_TOLERANCE_SHARE * high.max(axis=-1)).astype(np.int16)
    values = cells.astype(np.int16)
    return np.asarray(_largest(np.maximum(low - values, values - high)) - slack, np.int16)


def _settle(
    differs: NDArray[np.bool_],
    undecided: NDArray[np.bool_],
    for_floor: NDArray[np.bool_],
    against: NDArray[np.bool_],
) -> None:
    """Decide, in the caller's own array, each connected undecided part of one view.

    By whether it borders more on cells where the view was found to show the floor, or not.
    """
    number, labels = cv2.connectedComponents(undecided.astype(np.uint8), connectivity=4)
    around = np.ones((3, 3), np.uint8)
    votes = np.zeros(number)
    for cells, vote in ((for_floor, -1.0), (against, 1.0)):
        touched = np.asarray(cv2.dilate(cells.astype(np.uint8), around)) > 0
        votes += vote * np.bincount(np.asarray(labels)[touched & undecided], minlength=number)
    verdict = votes[labels]
    differs[undecided & (verdict > 0)] = True
    differs[undecided & (verdict < 0)] = False


def _largest(channels: NDArray[Channel]) -> NDArray[Channel]:
    """Return the largest of three channels; numpy's maximum over so short an axis is slow."""
    return np.asarray(
        np.maximum(np.maximum(channels[..., 0], channels[..., 1]), channels[..., 2]), channels.dtype
    )


def _grown(differs: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop what is at most two cells wide, which are edges that poses displace; grow the rest.

    A thing's outline is mixed with floor.
    """
    around = np.ones((3, 3), np.uint8)
    solid = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, around)
    grown: NDArray[np.bool_] = np.asarray(cv2.dilate(solid, around)) > 0
    return grown
