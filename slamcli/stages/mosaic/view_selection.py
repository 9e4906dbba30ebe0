"""View selection: which frames a mosaic is painted from, by their poses alone.

Of floor that is driven over again and again a few views are enough: the sharpest, and some from
elsewhere that show what is an obstacle. No other frame is decoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.camera.projection import project_floor
from slamcli.core.camera.resolution import floor_sampling
from slamcli.core.geometry import Grid
from slamcli.core.records import PosedFrame
from slamcli.stages.mosaic import tiles
from slamcli.stages.mosaic.tiles import TileKey

# Every tile that is seen, with the numbers of the posed frames that may see it.
Plan = list[tuple[TileKey, list[int]]]

# A tile that so few frames see is painted from all of them. In others the resolution of all views
# is compared at 9 by 9 probes [guarded by benchmarks/blends.py and benchmarks/scale.py].
_FEW_VIEWS, _PROBES = 24, 9
# A probe needs one view of nearly the best resolution, and so many of half of it as tell floor from
# obstacles; a tile's views are the best so many at any of its probes
# [guarded by benchmarks/blends.py and benchmarks/scale.py].
_SHARP_SHARE, _USEFUL_SHARE = 0.95, 0.5
_ENOUGH_VIEWS, _MAX_VIEWS = 8, 20
# A view from where another one was taken, to this share of the range, shows obstacles displaced
# alike, and counts less; one that another tile needs costs nothing, and counts more
# [guarded by benchmarks/scale.py].
_SAME_PLACE_SHARE, _SAME_PLACE_VALUE, _NEEDED_VALUE = 0.05, 0.1, 1.5
# The floor that a tile's frames see is compared at this many cells each way; strips narrower than
# 3 of them, by errors of poses, need no view of their own [guarded by benchmarks/scale.py].
_COVER_CELLS = 256


@dataclass(frozen=True, slots=True, eq=False)
class _Shots:
    """Posed frames as arrays.

    Attributes
    ----------
    posed : sequence of PosedFrame
    places : (N, 4) float64
        Metres in the map: where the robot is, and the middle of what it sees.
    same_place_metres : float
        How far apart two of these may be that are taken for one.
    """

    posed: Sequence[PosedFrame]
    places: Float64Array
    same_place_metres: float


def select_views(plan: Plan, posed_frames: Sequence[PosedFrame], metres_per_pixel: float) -> Plan:
    """Return a plan without the frames that add nothing to those that it keeps.

    The frames are chosen for the map as a whole, so that neighbouring tiles, of which each is
    painted from the best of them, show the same along their border.
    """
    if all(len(numbers) <= _FEW_VIEWS for _, numbers in plan):
        return plan
    shots = _shots(posed_frames)
    needed = np.zeros(len(posed_frames), np.bool_)
    for _, numbers in plan:
        if len(numbers) <= _FEW_VIEWS:
            needed[numbers] = True
    for key, numbers in plan:
        if len(numbers) > _FEW_VIEWS:
            grid = tiles.tile_grid(key, metres_per_pixel)
            _add_needed(grid, np.array(numbers), shots, needed)
    selected = [(key, [n for n in numbers if needed[n]]) for key, numbers in plan]
    return [
        (key, _best(tiles.tile_grid(key, metres_per_pixel), numbers, posed_frames))
        for key, numbers in selected
    ]


def _shots(posed_frames: Sequence[PosedFrame]) -> _Shots:
    places = []
    for posed in posed_frames:
        pose, middle = posed.map_from_robot, footprint_hull(posed.calibration).mean(axis=0)
        places.append((pose.x, pose.y, *pose.apply(middle[None])[0]))
    range_metres = max(posed.calibration.max_range_metres for posed in posed_frames)
    return _Shots(posed_frames, np.array(places), _SAME_PLACE_SHARE * range_metres)


def _add_needed(grid: Grid, numbers: Int64Array, shots: _Shots, needed: BoolArray) -> None:
    """Set `needed` of the frames that a tile needs: greedily, those that satisfy most probes."""
    pixels_per_metre = _resolutions(grid, numbers, shots.posed)
    best = pixels_per_metre.max(axis=0)
    sharp = (pixels_per_metre >= _SHARP_SHARE * best) & (best > 0)
    useful = (pixels_per_metre >= _USEFUL_SHARE * best) & (best > 0)
    lacks_sharp = best > 0
    lacking = np.minimum(useful.sum(axis=0), _ENOUGH_VIEWS)
    places = shots.places[numbers]
    value = np.where(needed[numbers], _NEEDED_VALUE, 1.0)
    chosen = np.zeros(len(numbers), np.bool_)
    while True:
        gain = _ENOUGH_VIEWS * (sharp & lacks_sharp).sum(axis=1) + value * (
            (useful & (lacking > 0)).sum(axis=1)
        )
        gain[chosen] = 0.0
        number = len(gain) - 1 - int(np.argmax(gain[::-1]))
        if gain[number] <= 0:
            break
        chosen[number] = True
        lacks_sharp &= ~sharp[number]
        lacking = lacking - useful[number]
        beside = np.abs(places - places[number]).max(axis=1) < shots.same_place_metres
        value[beside] = np.where(value[beside] >= 1.0, _SAME_PLACE_VALUE, 0.0)
    needed[numbers[chosen]] = True
    _cover(grid, numbers, shots.posed, needed)


def _cover(
    grid: Grid, numbers: Int64Array, posed_frames: Sequence[PosedFrame], needed: BoolArray
) -> None:
    """Set `needed` of the frames that see floor of a tile which no needed one does."""
    around = np.ones((3, 3), np.uint8)
    covered = np.zeros((_COVER_CELLS, _COVER_CELLS), np.uint8)
    for number in numbers[needed[numbers]]:
        covered |= _outline(grid, posed_frames[number])
    for number in numbers[~needed[numbers]][::-1]:
        if covered.all():
            return
        seen = _outline(grid, posed_frames[number])
        if cv2.erode(seen & ~covered, around).any():
            needed[number] = True
            covered |= seen


def _outline(grid: Grid, posed: PosedFrame) -> UInt8Array:
    """Return (cells, cells): 255 where a frame sees the floor of a tile, else 0."""
    outline = posed.map_from_robot.apply(footprint_hull(posed.calibration))
    scale = _COVER_CELLS / (grid.width * grid.metres_per_pixel)
    corners = (outline - (grid.x_min, grid.y_max)) * (scale, -scale)
    seen = np.zeros((_COVER_CELLS, _COVER_CELLS), np.uint8)
    cv2.fillConvexPoly(seen, np.rint(corners).astype(np.int32), 255)
    return seen


def _best(grid: Grid, numbers: list[int], posed_frames: Sequence[PosedFrame]) -> list[int]:
    """Return the frames that are among the best anywhere in a tile, or see only its rim."""
    if len(numbers) <= _FEW_VIEWS:
        return numbers
    pixels_per_metre = _resolutions(grid, np.array(numbers), posed_frames)
    rank = np.argsort(np.argsort(-pixels_per_metre, axis=0, kind="stable"), axis=0, kind="stable")
    best = (rank < _MAX_VIEWS) & (pixels_per_metre > 0)
    # A frame that sees no probe may still see a corner of the tile.
    kept = np.flatnonzero(best.any(axis=1) | ~pixels_per_metre.any(axis=1))
    return [numbers[int(index)] for index in kept]


def _resolutions(
    grid: Grid, numbers: Int64Array, posed_frames: Sequence[PosedFrame]
) -> Float64Array:
    """Return (N, probes): how many pixels a metre of floor spans in each frame; 0 unseen."""
    share = np.linspace(0.0, 1.0, _PROBES)
    x, y = np.meshgrid(
        grid.x_min + share * (grid.x_max - grid.x_min),
        grid.y_min + share * (grid.y_max - grid.y_min),
    )
    probes = np.column_stack([x.ravel(), y.ravel()])
    pixels_per_metre = np.zeros((len(numbers), len(probes)))
    of_calibration: dict[int, list[int]] = {}
    for index, number in enumerate(numbers):
        of_calibration.setdefault(id(posed_frames[number].calibration), []).append(index)
    for indices in of_calibration.values():
        members = [posed_frames[numbers[index]] for index in indices]
        floor = np.concatenate([one.map_from_robot.inverse().apply(probes) for one in members])
        _, seen = project_floor(members[0].calibration, floor)
        found = np.zeros(len(floor))
        sampled = floor_sampling(members[0].calibration, floor[seen])
        found[seen] = 1.0 / np.sqrt(sampled.prod(axis=1))
        pixels_per_metre[indices] = found.reshape(len(indices), -1)
    return pixels_per_metre
