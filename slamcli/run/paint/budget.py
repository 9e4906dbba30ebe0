"""The budget of painting: memory for pictures and canvases, and disk for tiles."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from slamcli.core.config import ProductOptions
from slamcli.core.errors import InputError
from slamcli.stages.mosaic import tiles
from slamcli.stages.mosaic.painter import Painter
from slamcli.stages.mosaic.tiles import TileKey

# Every tile that is seen, with the numbers of the shots that may see it; from `Painter.plan`.
Plan = Sequence[tuple[TileKey, list[int]]]

_MIN_PICTURES = 4
# Linux lists a process's pages here; the second number is of those in memory.
_RESIDENT = Path("/proc/self/statm")
# Arrays of a tile that is being painted, at their most: its pixels, and the cells of each view.
_TILE_BYTES, _TILE_VIEW_BYTES = 60_000_000, 350_000
_STORED_TILE_BYTES = tiles.TILE_PIXELS**2 * 3 + tiles.TILE_PIXELS**2 // 8
_LAYER_BYTES = {"resolution": 4, "views": 2, "last-frame": 4}


def max_pictures(picture_bytes: int, memory_bytes: int, canvas_bytes: int, workers: int) -> int:
    """Return how many frames may be in memory beside all else that the process has allocated.

    A few may in any case: the memory of a long drive's poses cannot be given back.

    Raises
    ------
    InputError
        When the memory is too little even for a process that has allocated nothing yet.
    """
    room = memory_bytes - canvas_bytes
    min_count = max(_MIN_PICTURES, 2 * workers)
    if room < min_count * picture_bytes:
        raise InputError(
            f"--memory {size_text(memory_bytes)} is too little to paint in; give "
            f"{size_text(canvas_bytes + min_count * picture_bytes)} or more, or fewer --workers"
        )
    return max(min_count, (room - _resident_bytes()) // picture_bytes)


def max_at_once(needed: Sequence[Sequence[int]]) -> int:
    """Return how many pictures are in memory when each leaves after the last tile that needs it.

    Parameters
    ----------
    needed : sequence of sequence of int
        The numbers that each tile needs, in the tiles' order.
    """
    last = {number: place for place, numbers in enumerate(needed) for number in numbers}
    kept: set[int] = set()
    most = 0
    for place, numbers in enumerate(needed):
        kept |= set(numbers)
        most = max(most, len(kept))
        kept -= {number for number in numbers if last[number] == place}
    return most


def tile_bytes(plan: Plan) -> int:
    """Return the memory of painting the tile that most frames see."""
    return _TILE_BYTES + _TILE_VIEW_BYTES * max(len(numbers) for _, numbers in plan)


def estimate(
    painter: Painter, plan: Plan, options: ProductOptions, pictures: int, workers: int
) -> str:
    """Return a line on the map's size, and the disk and memory that painting it takes.

    Parameters
    ----------
    pictures : int
        Most frames in memory.
    """
    grid = tiles.extent_of([key for key, _ in plan], painter.metres_per_pixel)
    assert grid is not None
    layers = sum(_LAYER_BYTES[layer] for layer in options.layers) * tiles.TILE_PIXELS**2
    disk = len(plan) * (_STORED_TILE_BYTES + layers)
    kept = min(pictures, max_at_once([numbers for _, numbers in plan]))
    memory = kept * painter.picture_bytes + workers * tile_bytes(plan)
    return (
        f"up to {grid.width}x{grid.height} pixels of {painter.metres_per_pixel:g} "
        f"{painter.calibration.unit}, {len(plan)} tiles; about {size_text(disk)} of disk, "
        f"{size_text(memory)} of memory"
    )


def size_text(count: float) -> str:
    """Return a number of bytes with a unit."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def _resident_bytes() -> int:
    """Return the memory that this process takes; 0 where the system does not list it."""
    try:
        pages = _RESIDENT.read_text().split()[1]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
