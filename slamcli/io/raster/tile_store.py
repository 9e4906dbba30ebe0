"""A sparse raster of finished tiles on disk: memory does not grow with the map."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import cv2
import numpy as np

from slamcli.core.arrays import GenericArray, UInt8Array
from slamcli.core.errors import InputError, OutputError
from slamcli.core.geometry import Grid
from slamcli.core.records import FloorEvidence, Tile
from slamcli.io.files import write_bytes

_EVIDENCE = ("baseline_metres", "texture_gray", "differs")
_NAME = re.compile(r"(-?\d+)_(-?\d+)\.npz")


@dataclass(frozen=True, slots=True, eq=False)
class StoredTile:
    """A painted tile as it is stored.

    Attributes
    ----------
    image : (h, w, 3) uint8, BGR
    mask : (h, w) uint8
        255 where the floor was seen.
    obstacles : (h, w, 4) uint8 BGRA or None
    layers : dict of str to (h, w) array
        The chosen ones: ``resolution`` (float32, metres of floor that a picture's pixel covers; 0:
        unseen), ``views`` (uint16), ``last-frame`` (int32; -1: unseen).
    evidence : FloorEvidence or None
    """

    image: UInt8Array
    mask: UInt8Array
    obstacles: UInt8Array | None
    layers: dict[str, GenericArray]
    evidence: FloorEvidence | None = None


@dataclass(frozen=True, slots=True)
class _Entry:
    """Where in a tile floor was seen: first and last row and column, and how many pixels.

    And whether the tile has an obstacle.
    """

    top: int
    bottom: int
    left: int
    right: int
    seen: int
    has_obstacle: bool


class TileStore:
    """A sparse raster of tiles in a folder; only what was seen takes space.

    Parameters
    ----------
    folder : Path
        Made when missing. Tiles that are already in it, of an interrupted run, are kept, but for
        damaged ones.
    tile_pixels : int
    layers : tuple of str
        Which layers to keep; see `StoredTile`.
    """

    def __init__(self, folder: Path, tile_pixels: int, layers: tuple[str, ...] = ()) -> None:
        self.folder = folder
        self.tile_pixels = tile_pixels
        self.layers = layers
        self._entries: dict[tuple[int, int], _Entry | None] = {}
        self._unfinished: set[tuple[int, int]] = set()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot write {folder}: {error.strerror or error}") from error
        for path in sorted(folder.iterdir()):
            name = _NAME.fullmatch(path.name)
            if name is not None:
                row, column = int(name[1]), int(name[2])
                with suppress(InputError):
                    self._entries[row, column] = _entry(self._read(row, column))

    def __contains__(self, key: tuple[int, int]) -> bool:
        return key in self._entries

    def put(self, row: int, column: int, tile: Tile | None, *, finished: bool = True) -> None:
        """Store a tile, completely or not at all; None notes that nothing is seen there.

        One that is not finished is in this store alone: another of the same folder lacks it.
        """
        if not finished:
            self._unfinished.add((row, column))
        stream = io.BytesIO()
        if tile is None:
            np.savez(stream, empty=np.zeros(0, np.uint8))
            self._entries[row, column] = None
        else:
            mask = np.where(tile.pixels_per_metre > 0, np.uint8(255), np.uint8(0))
            arrays: dict[str, GenericArray] = {
                "image": tile.image,
                "mask": np.packbits(mask > 0, axis=1),
            }
            if tile.obstacles is not None:
                arrays["obstacles"] = tile.obstacles
            if tile.evidence is not None:
                for name in _EVIDENCE:
                    arrays[name] = getattr(tile.evidence, name)
            for layer in self.layers:
                arrays[layer] = _layer(tile, layer)
            np.savez(stream, allow_pickle=False, **arrays)
            self._entries[row, column] = _entry_of(mask, has_obstacle=tile.obstacles is not None)
        # A tile that the power failure cuts is found damaged, and is painted again.
        write_bytes(self._path(row, column), stream.getvalue(), durable=False)

    def get(self, row: int, column: int) -> StoredTile | None:
        """Return a tile; None where nothing was seen."""
        if self._entries.get((row, column)) is None:
            return None
        return self._read(row, column)

    def keys(self) -> list[tuple[int, int]]:
        """Return row and column of every tile with something in it, from the upper left on."""
        return sorted(key for key, entry in self._entries.items() if entry is not None)

    def tiles(self, grid: Grid) -> Iterator[tuple[int, int, StoredTile]]:
        """Yield the pixel row and column in a grid, which may be negative, and each of its tiles.

        The grid's corners lie on whole pixels of the map.
        """
        side = self.tile_pixels
        top, left = (
            round(-grid.y_max / grid.metres_per_pixel),
            round(grid.x_min / grid.metres_per_pixel),
        )
        for row, column in self.keys():
            down, right = row * side - top, column * side - left
            if -side < down < grid.height and -side < right < grid.width:
                tile = self._read(row, column)
                assert tile is not None
                yield down, right, tile

    def seen_pixels(self) -> int:
        """Return how many pixels of the map were seen."""
        return sum(entry.seen for entry in self._entries.values() if entry is not None)

    def has_obstacles(self) -> bool:
        """Return whether any tile has an obstacle."""
        return any(entry is not None and entry.has_obstacle for entry in self._entries.values())

    def bounds(self) -> tuple[int, int, int, int] | None:
        """Return top, bottom, left and right of what was seen, in the map's pixels, ends excluded.

        None when nothing was.
        """
        side = self.tile_pixels
        found = [
            (
                row * side + entry.top,
                row * side + entry.bottom + 1,
                column * side + entry.left,
                column * side + entry.right + 1,
            )
            for (row, column), entry in self._entries.items()
            if entry is not None
        ]
        if not found:
            return None
        tops, bottoms, lefts, rights = zip(*found, strict=True)
        return min(tops), max(bottoms), min(lefts), max(rights)

    def flatten(self, grid: Grid) -> tuple[UInt8Array, UInt8Array]:
        """Return the picture (h, w, 3) BGR of a grid on whole map pixels, and its mask (h, w)."""
        image = np.zeros((grid.height, grid.width, 3), np.uint8)
        mask = np.zeros((grid.height, grid.width), np.uint8)
        for row, column, tile in self.tiles(grid):
            put_part(image, tile.image, row, column)
            put_part(mask, tile.mask, row, column)
        return image, mask

    def overview(self, grid: Grid, factor: int) -> tuple[UInt8Array, UInt8Array]:
        """Return picture and mask of a grid, reduced by a factor, tile by tile.

        Parameters
        ----------
        grid : Grid
            Its corners lie on tiles' corners, or the factor is 1.
        factor : int
            Divides a tile's side.
        """
        if factor == 1:
            return self.flatten(grid)
        shape = (-(-grid.height // factor), -(-grid.width // factor))
        image, mask = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.uint8)
        for row, column, tile in self.tiles(grid):
            small, seen = reduced(tile.image, tile.mask, factor)
            put_part(image, small, row // factor, column // factor)
            put_part(mask, seen, row // factor, column // factor)
        return image, mask

    def _path(self, row: int, column: int) -> Path:
        mark = ".unfinished" if (row, column) in self._unfinished else ""
        return self.folder / f"{row}_{column}{mark}.npz"

    def _read(self, row: int, column: int) -> StoredTile | None:
        path = self._path(row, column)
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as arrays:
                if "empty" in arrays:
                    return None
                mask = np.unpackbits(arrays["mask"], axis=1) * np.uint8(255)
                obstacles = arrays.get("obstacles")
                layers = {layer: arrays[layer] for layer in self.layers}
                evidence = None
                if _EVIDENCE[0] in arrays:
                    evidence = FloorEvidence(*(arrays[name] for name in _EVIDENCE))
                tile = StoredTile(arrays["image"], mask, obstacles, layers, evidence)
        except (OSError, EOFError, ValueError, KeyError, BadZipFile, zlib.error) as error:
            raise InputError(f"cannot read the finished tile {path}: {error}") from error
        parts = [tile.image, tile.mask, *layers.values()]
        if any(part.shape[:2] != (self.tile_pixels, self.tile_pixels) for part in parts):
            raise InputError(f"cannot read the finished tile {path}: its size is wrong")
        return tile


def put_part(canvas: GenericArray, part: GenericArray, row: int, column: int) -> None:
    """Write a part at (row, column) into an array that the caller owns, clipped to it."""
    height, width = part.shape[:2]
    rows = slice(max(0, row), min(canvas.shape[0], row + height))
    columns = slice(max(0, column), min(canvas.shape[1], column + width))
    if rows.start < rows.stop and columns.start < columns.stop:
        canvas[rows, columns] = part[
            rows.start - row : rows.stop - row, columns.start - column : columns.stop - column
        ]


def reduced(image: UInt8Array, mask: UInt8Array, factor: int) -> tuple[UInt8Array, UInt8Array]:
    """Return a picture and its mask, smaller by a factor: the mean of what was seen."""
    size = (image.shape[1] // factor, image.shape[0] // factor)
    if mask.all():
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8), np.full(size[::-1], 255, np.uint8)
    seen = (mask > 0).astype(np.float32)
    share = np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_AREA), np.float32)
    weighted = image.astype(np.float32) * seen[..., None]
    total = np.asarray(cv2.resize(weighted, size, interpolation=cv2.INTER_AREA), np.float32)
    colour = np.rint(total / np.maximum(share, np.float32(1e-6))[..., None])
    return (
        np.clip(colour, 0, 255).astype(np.uint8),
        np.where(share > 0, np.uint8(255), np.uint8(0)),
    )


def _layer(tile: Tile, layer: str) -> GenericArray:
    if layer == "views":
        return tile.views
    if layer == "last-frame":
        return tile.latest
    seen = tile.pixels_per_metre > 0
    safe = np.where(seen, tile.pixels_per_metre, np.float32(1.0))
    return np.where(seen, np.float32(1.0) / safe, np.float32(0.0))


def _entry(tile: StoredTile | None) -> _Entry | None:
    return None if tile is None else _entry_of(tile.mask, has_obstacle=tile.obstacles is not None)


def _entry_of(mask: UInt8Array, *, has_obstacle: bool) -> _Entry | None:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if rows.size == 0:
        return None
    seen = int(np.count_nonzero(mask))
    bounds = int(rows[0]), int(rows[-1]), int(columns[0]), int(columns[-1])
    return _Entry(*bounds, seen, has_obstacle)
