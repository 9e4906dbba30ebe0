"""Floor textures, procedural: made block by block from the seed, unbounded, without repetition.

A block is filtered white noise; the noise of a pixel depends on the seed and its position alone, so
neighbouring blocks meet without a seam.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Condition
from typing import Protocol

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array, UInt16Array
from slamcli.core.geometry import Grid
from slamcli.core.light import light_in_16_bits
from slamcli.simulation.config import FloorOptions
from slamcli.simulation.floors import course, laid, paper, poured
from slamcli.simulation.floors.noise import Seed

BLOCK_PIXELS = 512
# Enough for the floor before a robot; older blocks are made again when it comes back.
_MAX_BLOCKS = 600
# A camera sees far more floor from afar, at coarse levels: from this level on more blocks are kept.
_COARSE_LEVEL, _MAX_COARSE_BLOCKS = 3, 12_000
# The coarsest level that is read; a block has one more.
MAX_LEVEL = 5
_LEVELS = 6


Texture = UInt8Array | UInt16Array


class Floor(Protocol):
    """A texture that can be read anywhere, at any scale."""

    metres_per_pixel: float
    in_light: bool

    def region(self, grid: Grid) -> Texture:
        """Return (h, w, 3) BGR of a grid whose resolution is 2^n times the floor's own.

        Light as uint16, white 65535, where the floor is `in_light`; else encoded gray as uint8.
        """


class BlockFloor:
    """An unbounded floor, made block by block; may be shared by threads.

    Parameters
    ----------
    make_block : callable
        Of a grid, at the floor's own resolution, to (h, w, 3) uint8 BGR.
    metres_per_pixel : float
    in_light : bool
        Coarser levels are means of light, not of its code.
    """

    def __init__(
        self,
        make_block: Callable[[Grid], UInt8Array],
        metres_per_pixel: float,
        *,
        in_light: bool = False,
    ) -> None:
        self.metres_per_pixel = metres_per_pixel
        self.in_light = in_light
        self._make_block = make_block
        self._made = Condition()
        self._in_work: set[tuple[int, int]] = set()
        self._blocks: OrderedDict[tuple[int, int], list[Texture]] = OrderedDict()
        self._coarse: OrderedDict[tuple[int, int], list[Texture]] = OrderedDict()

    def region(self, grid: Grid) -> Texture:
        """Return (h, w, 3) BGR of a grid whose resolution is 2^n times the floor's own."""
        level = round(np.log2(grid.metres_per_pixel / self.metres_per_pixel))
        side = BLOCK_PIXELS >> level
        left = round(grid.x_min / grid.metres_per_pixel)
        top = round(-grid.y_max / grid.metres_per_pixel)
        image = np.empty((grid.height, grid.width, 3), np.uint16 if self.in_light else np.uint8)
        for row in range(top // side, (top + grid.height - 1) // side + 1):
            for column in range(left // side, (left + grid.width - 1) // side + 1):
                y, x = row * side - top, column * side - left
                rows = slice(max(0, y), min(grid.height, y + side))
                columns = slice(max(0, x), min(grid.width, x + side))
                block = self._block((column, row), level)
                image[rows, columns] = block[
                    rows.start - y : rows.stop - y, columns.start - x : columns.stop - x
                ]
        return image

    def _block(self, key: tuple[int, int], level: int) -> Texture:
        """Return one level of the block at a (column, row); other threads wait for one in work."""
        first, kept = (_COARSE_LEVEL, self._coarse) if level >= _COARSE_LEVEL else (0, self._blocks)
        with self._made:
            while key not in kept and key in self._in_work:
                self._made.wait()
            if key in kept:
                kept.move_to_end(key)
                return kept[key][level - first]
            self._in_work.add(key)
        levels = self._pyramid(*key)
        with self._made:
            self._in_work.remove(key)
            if not first:
                _keep(self._blocks, key, levels, _MAX_BLOCKS)
            _keep(self._coarse, key, levels[_COARSE_LEVEL:], _MAX_COARSE_BLOCKS)
            self._made.notify_all()
        return levels[level]

    def _pyramid(self, column: int, row: int) -> list[Texture]:
        """Make a block: its levels, each the plain mean of four pixels below."""
        span = BLOCK_PIXELS * self.metres_per_pixel
        grid = Grid(column * span, -row * span, self.metres_per_pixel, BLOCK_PIXELS, BLOCK_PIXELS)
        block = self._make_block(grid)
        levels: list[Texture] = [light_in_16_bits(block) if self.in_light else block]
        for _ in range(_LEVELS):
            half = levels[-1].shape[0] // 2
            smaller = cv2.resize(levels[-1], (half, half), interpolation=cv2.INTER_AREA)
            levels.append(smaller)  # type: ignore[arg-type]
        return levels


def _keep(
    kept: OrderedDict[tuple[int, int], list[Texture]],
    key: tuple[int, int],
    levels: list[Texture],
    most: int,
) -> None:
    kept[key] = levels
    if len(kept) > most:
        kept.popitem(last=False)


def make_floor(
    kind: str,
    options: FloorOptions,
    metres_per_pixel: float,
    seed: int,
    *,
    in_light: bool = False,
) -> BlockFloor:
    """Return a floor of a kind in `FLOORS`."""
    make = FLOORS[kind]
    # Worlds of encoded gray keep the noise that they had at first.
    number = Seed(seed, quick=in_light)
    return BlockFloor(lambda grid: make(grid, options, number), metres_per_pixel, in_light=in_light)


def make_wall(
    options: FloorOptions, metres_per_pixel: float, seed: int, *, in_light: bool = False
) -> BlockFloor:
    """Return what hangs on a wall without end: x along it, y up from the floor."""
    number = Seed(seed, quick=in_light)
    return BlockFloor(
        lambda grid: laid.wall(grid, options.wear, number), metres_per_pixel, in_light=in_light
    )


def picture_floor(
    picture: UInt8Array, metres_per_pixel: float, *, in_light: bool = False
) -> BlockFloor:
    """Return a picture (H, W, 3) laid on the floor, centred at the origin, mirrored endlessly."""
    height, width = picture.shape[:2]
    mirrored = np.vstack(
        [np.hstack([picture, picture[:, ::-1]]), np.hstack([picture[::-1], picture[::-1, ::-1]])]
    )

    def make(grid: Grid) -> UInt8Array:
        left = round(grid.x_min / metres_per_pixel) + width // 2
        top = round(-grid.y_max / metres_per_pixel) + height // 2
        rows = np.arange(top, top + grid.height) % (2 * height)
        columns = np.arange(left, left + grid.width) % (2 * width)
        return np.ascontiguousarray(mirrored[rows[:, None], columns])

    return BlockFloor(make, metres_per_pixel, in_light=in_light)


FLOORS: dict[str, Callable[[Grid, FloorOptions, Seed], UInt8Array]] = {
    "asphalt": poured.asphalt,
    "bare": poured.bare,
    "carpet": laid.carpet,
    "carpet-tiles": laid.carpet_tiles,
    "concrete": poured.concrete,
    "course": course.course,
    "paper": paper.paper,
    "parquet": laid.parquet,
    "planks": laid.planks,
    "road": poured.road,
    "terrazzo": poured.terrazzo,
    "tiles": laid.tiles,
}
