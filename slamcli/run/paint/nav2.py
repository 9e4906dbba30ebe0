"""A map for planners: nav2.pgm with its description, and obstacles.geojson with the outlines."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from slamcli.core.arrays import BoolArray, Float32Array, UInt8Array
from slamcli.core.geometry import Grid
from slamcli.core.records import FloorEvidence
from slamcli.io.geojson import Polygon, write_polygons
from slamcli.io.raster import world_file
from slamcli.io.raster.tile_store import put_part, reduced
from slamcli.run.paint.map_to_write import MapToWrite
from slamcli.stages.mosaic import obstacles, occupancy, tiles

_MAX_FACTOR = 64
# Cells are decided in blocks, so that memory does not grow with the map, with a margin that is
# wider than most things.
_BLOCK_CELLS, _MARGIN_CELLS = 1024, 128
# Of each tile this many rows and columns of cells are left out between two whose texture counts.
_TEXTURE_STEP = 4


def write_nav2(output: MapToWrite) -> None:
    """Write free, occupied and unknown at a planner's resolution, and the obstacles' outlines."""
    scale = output.grid.metres_per_pixel
    factor = 1
    max_scale = output.options.nav_metres_per_pixel * (1 + 1e-9)
    while scale * factor * 2 <= max_scale and factor < _MAX_FACTOR:
        factor *= 2
    grid = tiles.whole_tiles(output.grid)
    if output.options.nav_lines:
        gray = _line_grays(output, grid, factor)
    else:
        cells = _cell_grays(output, grid)
        _write_outlines(output, grid, cells)
        gray = _at_factor(cells, factor)
    known = cv2.findNonZero((gray != world_file.UNKNOWN_GRAY).astype(np.uint8))
    # A map of which nothing is known is one unknown cell.
    left, top, width, height = (0, 0, 1, 1) if known is None else cv2.boundingRect(known)
    small = Grid(grid.x_min, grid.y_max, scale * factor, gray.shape[1], gray.shape[0])
    path = output.path("nav2", ".pgm")
    world_file.write_pgm(path, gray[top : top + height, left : left + width])
    world_file.write_nav2_map(
        output.path("nav2", ".yaml"),
        path.name,
        small.window(left, top, width, height),
        output.unit,
        output.map_from_painted,
    )


def _line_grays(output: MapToWrite, grid: Grid, factor: int) -> UInt8Array:
    """Return (h, w) gray levels of Nav2: painted lines occupied, all other floor free."""
    image, mask = output.store.overview(grid, factor)
    gray = np.where(mask > 0, np.uint8(world_file.FREE_GRAY), np.uint8(world_file.UNKNOWN_GRAY))
    lines = obstacles.line_cells(image, mask, grid.metres_per_pixel * factor)
    gray[lines] = world_file.OCCUPIED_GRAY
    return gray


def _cell_grays(output: MapToWrite, grid: Grid) -> UInt8Array:
    """Return (h, w) gray levels of Nav2, one for each cell of whole tiles."""
    side = tiles.CELL_PIXELS
    cell = grid.metres_per_pixel * side
    shape = (grid.height // side, grid.width // side)
    gray = np.full(shape, world_file.UNKNOWN_GRAY, np.uint8)
    camera = output.calibration
    baseline = occupancy.min_baseline(cell, camera.height_metres, metric=camera.unit == "m")
    plain = occupancy.plain_below(_textures(output, grid))
    driven = _driven(output, grid, shape)
    for rows, columns, inner in _blocks(shape):
        evidence, colours = _evidence(output, grid, rows, columns)
        found = occupancy.classify(evidence, colours, driven[rows, columns], plain, baseline)
        block = np.full(found.free.shape, world_file.UNKNOWN_GRAY, np.uint8)
        block[found.free] = world_file.FREE_GRAY
        block[found.occupied] = world_file.OCCUPIED_GRAY
        gray[inner] = block[
            inner[0].start - rows.start : inner[0].stop - rows.start,
            inner[1].start - columns.start : inner[1].stop - columns.start,
        ]
    return gray


def _blocks(shape: tuple[int, int]) -> Iterator[tuple[slice, slice, tuple[slice, slice]]]:
    """Yield the rows and columns of each block with its margin, and the block itself."""
    for top in range(0, shape[0], _BLOCK_CELLS):
        for left in range(0, shape[1], _BLOCK_CELLS):
            inner = tuple(
                slice(start, min(end, start + _BLOCK_CELLS))
                for start, end in ((top, shape[0]), (left, shape[1]))
            )
            rows, columns = (
                slice(max(0, part.start - _MARGIN_CELLS), min(end, part.stop + _MARGIN_CELLS))
                for part, end in zip(inner, shape, strict=True)
            )
            yield rows, columns, (inner[0], inner[1])


def _evidence(
    output: MapToWrite, grid: Grid, rows: slice, columns: slice
) -> tuple[FloorEvidence, UInt8Array]:
    """Return the evidence of some cells, and the map's colours, from the tiles that have them."""
    side = tiles.CELL_PIXELS
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    baseline = np.full(shape, -1.0, np.float32)
    texture, differs = np.full(shape, np.nan, np.float32), np.zeros(shape, np.bool_)
    colours = np.zeros((*shape, 3), np.uint8)
    window = grid.window(columns.start * side, rows.start * side, shape[1] * side, shape[0] * side)
    for row, column, tile in output.store.tiles(window):
        if tile.evidence is not None:
            place = row // side, column // side
            put_part(baseline, tile.evidence.baseline_metres, *place)
            put_part(texture, tile.evidence.texture_gray, *place)
            put_part(differs, tile.evidence.differs, *place)
            put_part(colours, reduced(tile.image, tile.mask, side)[0], *place)
    return FloorEvidence(baseline, texture, differs), colours


def _textures(output: MapToWrite, grid: Grid) -> Float32Array:
    """Return the texture of some cells of every tile."""
    step = slice(None, None, _TEXTURE_STEP)
    found = [
        tile.evidence.texture_gray[step, step].ravel()
        for _, _, tile in output.store.tiles(grid)
        if tile.evidence is not None
    ]
    return np.concatenate(found) if found else np.zeros(0, np.float32)


def _driven(output: MapToWrite, grid: Grid, shape: tuple[int, int]) -> BoolArray:
    cell = grid.metres_per_pixel * tiles.CELL_PIXELS
    columns, rows = (
        np.floor((output.positions - (grid.x_min, grid.y_max)) / (cell, -cell)).astype(int).T
    )
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    driven = np.zeros(shape, np.bool_)
    driven[rows[inside], columns[inside]] = True
    return driven


def _at_factor(cells: UInt8Array, factor: int) -> UInt8Array:
    """Return the cells' gray levels for blocks of factor x factor pixels."""
    side = tiles.CELL_PIXELS
    if factor <= side:
        times = side // factor
        return cells.repeat(times, axis=0).repeat(times, axis=1)
    many = factor // side
    height, width = cells.shape[0] // many, cells.shape[1] // many
    parts = cells[: height * many, : width * many].reshape(height, many, width, many)
    gray = np.full((height, width), world_file.UNKNOWN_GRAY, np.uint8)
    gray[(parts == world_file.FREE_GRAY).all(axis=(1, 3))] = world_file.FREE_GRAY
    gray[(parts == world_file.OCCUPIED_GRAY).any(axis=(1, 3))] = world_file.OCCUPIED_GRAY
    return gray


def _write_outlines(output: MapToWrite, grid: Grid, cells: UInt8Array) -> None:
    cell = grid.metres_per_pixel * tiles.CELL_PIXELS
    polygons = []
    for corners in occupancy.outlines(cells == world_file.OCCUPIED_GRAY):
        painted = np.array([grid.x_min, grid.y_max]) + corners * (cell, -cell)
        area = occupancy.signed_area(painted)
        ordered = painted if area > 0 else painted[::-1]
        properties = {"area": round(abs(area), 6)}
        polygons.append(Polygon(output.map_from_painted.apply(ordered), properties))
    write_polygons(output.path("obstacles", ".geojson"), polygons, output.unit)
