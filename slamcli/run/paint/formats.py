"""The formats that a painted map is written in, each from its store of tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from slamcli.core.arrays import Float64Array, GenericArray, UInt8Array, UInt16Array
from slamcli.core.config import Layer
from slamcli.core.errors import InputError
from slamcli.core.geometry import Grid
from slamcli.io.files import write_drawing
from slamcli.io.raster import deepzoom, geotiff, png, world_file
from slamcli.io.raster.tile_store import StoredTile, TileStore, put_part
from slamcli.run.paint import nav2
from slamcli.run.paint.map_to_write import MapToWrite
from slamcli.stages.geodesy import project_map
from slamcli.stages.mosaic import tiles

# Layers of a PNG are 16 bits deep; a resolution is given in micrometres.
_MAX_GRAY = 65535
# A pixel of a map a million pixels wide moves by less.
_AXIS_SHARE = 1e-9
_KINDS = {"resolution": ("float32", 0.0), "views": ("uint16", None), "last-frame": ("int32", -1.0)}


def _write_png(output: MapToWrite) -> None:
    path = output.path("mosaic", ".png")
    _write_strips(output, path, _floor_strip)
    world_file.write_nav2_map(
        output.path("mosaic", ".yaml"),
        path.name,
        output.grid,
        output.unit,
        output.map_from_painted,
        occupancy=False,
    )
    if output.store.has_obstacles():
        _write_strips(output, output.path("obstacles", ".png"), _obstacle_strip)
    for name in output.options.layers:
        pixels = np.zeros((output.grid.height, output.grid.width), np.uint16)
        for row, column, tile in output.store.tiles(output.grid):
            put_part(pixels, _deep_gray(name, tile.layers[name]), row, column)
        write_drawing(output.path(name, ".png"), pixels)  # type: ignore[arg-type]
        world_file.write_world_file(output.path(name, ".pgw"), output.grid, output.map_from_painted)


def _write_strips(
    output: MapToWrite, path: Path, strip: Callable[[TileStore, Grid], png.Strip]
) -> None:
    """Write a PNG strip by strip, so that its pixels are never in memory at once."""
    grid, side = output.grid, tiles.TILE_PIXELS
    # Cut where tiles end, so that none is read twice.
    first = side - round(-grid.y_max / grid.metres_per_pixel) % side
    starts = [0, *range(first, grid.height, side)]
    ends = [*starts[1:], grid.height]
    parts = [
        grid.window(0, start, grid.width, end - start)
        for start, end in zip(starts, ends, strict=True)
    ]
    work = partial(strip, output.store)
    png.write_png(path, grid.width, grid.height, output.session.ordered(work, parts))
    world_file.write_world_file(path.with_suffix(".pgw"), grid, output.map_from_painted)


def _floor_strip(store: TileStore, grid: Grid) -> png.Strip:
    return png.compress(*store.flatten(grid))


def _obstacle_strip(store: TileStore, grid: Grid) -> png.Strip:
    layer = np.zeros((grid.height, grid.width, 4), np.uint8)
    for row, column, tile in store.tiles(grid):
        if tile.obstacles is not None:
            put_part(layer, tile.obstacles, row, column)
    return png.compress(layer)


def _write_geotiff(output: MapToWrite) -> None:
    shape = (output.grid.height, output.grid.width)
    transform = output.map_from_painted.matrix @ output.grid.metres_from_corner
    datum, crs = output.options.datum, None
    if datum is not None:
        placed = project_map(datum, output.options.crs)
        crs, transform = placed.crs, _axis_aligned(placed.projected_from_map @ transform)

    def write(
        stem: str,
        bands: int,
        kind: str,
        pixels: Callable[[StoredTile], GenericArray | None],
        nodata: float | None,
    ) -> None:
        layout = geotiff.RasterLayout(shape, bands, kind, transform, crs, nodata)
        geotiff.write_geotiff(output.path(stem, ".tif"), layout, _blocks(output, pixels))

    write("mosaic", 4, "uint8", lambda tile: world_file.transparent(tile.image, tile.mask), None)
    if output.store.has_obstacles():
        write("obstacles", 4, "uint8", lambda tile: tile.obstacles, None)
    for name in output.options.layers:
        kind, nodata = _KINDS[name]
        write(name, 1, kind, lambda tile, name=name: tile.layers[name], nodata)  # type: ignore[misc]


def _axis_aligned(transform: Float64Array) -> Float64Array:
    """Return a transform without the rounding errors of one whose axes are east and north."""
    aligned = transform.copy()
    linear = aligned[:2, :2]
    linear[np.abs(linear) < _AXIS_SHARE * np.abs(linear).max()] = 0.0
    return aligned


def _write_deep_zoom(output: MapToWrite) -> None:
    grid = output.grid
    side = tiles.TILE_PIXELS
    aligned = tiles.whole_tiles(grid)
    margin = (
        round((aligned.y_max - grid.y_max) / grid.metres_per_pixel),
        round((grid.x_min - aligned.x_min) / grid.metres_per_pixel),
    )

    def cut() -> Iterator[tuple[int, int, UInt8Array]]:
        for row, column, tile in output.store.tiles(aligned):
            pixels = world_file.transparent(tile.image, tile.mask)
            if output.options.crop is not None:
                outside = np.ones(pixels.shape[:2], np.bool_)
                inside = np.zeros((grid.height, grid.width), np.bool_)
                put_part(outside, inside, margin[0] - row, margin[1] - column)
                pixels[outside] = 0
            yield row // side, column // side, pixels

    name = f"mosaic{output.suffix}"
    deepzoom.write_deep_zoom(output.folder, name, (aligned.width, aligned.height), side, cut())
    origin = output.map_from_painted
    deepzoom.write_position(
        output.folder / f"{name}.dzi.json",
        {
            "unit": output.unit,
            "metres_per_pixel": aligned.metres_per_pixel,
            "x_min": aligned.x_min,
            "y_max": aligned.y_max,
            "width": aligned.width,
            "height": aligned.height,
            "tile_pixels": side,
            "map_from_picture": [origin.x, origin.y, origin.theta],
        },
    )


def _blocks(
    output: MapToWrite, pixels: Callable[[StoredTile], GenericArray | None]
) -> Iterator[tuple[int, int, GenericArray]]:
    for row, column, tile in output.store.tiles(output.grid):
        part = pixels(tile)
        if part is not None:
            yield row, column, part


def _deep_gray(layer: Layer, values: GenericArray) -> UInt16Array:
    """Return a layer as 16-bit gray: micrometres, views, or the frame's index plus 1."""
    if layer == "resolution":
        whole = np.rint(values.astype(np.float64) * 1e6)
    else:
        whole = values.astype(np.float64) + (1 if layer == "last-frame" else 0)
    if whole.max(initial=0) > _MAX_GRAY:
        raise InputError(f"the layer {layer} does not fit into a PNG; use --format geotiff")
    return whole.astype(np.uint16)


FORMATS: dict[str, Callable[[MapToWrite], None]] = {
    "png": _write_png,
    "geotiff": _write_geotiff,
    "deepzoom": _write_deep_zoom,
    "nav2": nav2.write_nav2,
}
