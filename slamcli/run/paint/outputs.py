"""What is written of a finished map, all from one store of tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import GenericArray, UInt8Array, UInt16Array
from slamcli.core.camera.calibration import Unit
from slamcli.core.config import Datum, Layer, ProductOptions
from slamcli.core.errors import InputError
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import PoseEstimate
from slamcli.drawing.trajectory import draw_trajectory
from slamcli.io.files import write_image
from slamcli.io.raster import deepzoom, geotiff, png, world_file
from slamcli.io.raster.tile_store import StoredTile, TileStore, put_part
from slamcli.run.paint.paint import Scene, check_png, check_scene, cropped, paint_scene
from slamcli.run.session.executor import Progress, ordered
from slamcli.run.session.interruption import Interruption
from slamcli.stages.mosaic import obstacles, tiles

PRODUCTS = (
    "mosaic*.png",
    "mosaic*.yaml",
    "mosaic*.pgw",
    "mosaic*.tif",
    "mosaic*.dzi",
    "mosaic*_files",
    "obstacles*.png",
    "obstacles*.pgw",
    "obstacles*.tif",
    "trajectory*.png",
    "nav2*.pgm",
    "nav2*.yaml",
    "resolution*.*",
    "views*.*",
    "last-frame*.*",
)
# Layers of a PNG are 16 bits deep; a resolution is told in micrometres.
_MAX_GRAY = 65535
_KINDS = {"resolution": ("float32", 0.0), "views": ("uint16", None), "last-frame": ("int32", -1.0)}
_OVERVIEW_PIXELS = 1600


def write_maps(
    scenes: Sequence[tuple[Scene, Sequence[PoseEstimate]]],
    options: ProductOptions,
    datums: Mapping[int, Datum],
    staging: Path,
    tiles_folder: Path,
    workers: int,
    progress: Progress,
    tell: Callable[[str], None],
    interruption: Interruption,
    scheduler: str = "",
) -> float:
    """Paint every connected map and write it as asked; return the floor seen in all, m^2.

    The first is ``mosaic``, the next ``mosaic_1`` and so on. When the user interrupts, what has
    been painted is written.

    Parameters
    ----------
    datums : mapping of int to Datum
        Where fragments lie on Earth, for those that the options do not tell it of.
    """
    for scene, _ in scenes:
        check_scene(scene, options)
    area = 0.0
    for number, (scene, estimates) in enumerate(scenes):
        suffix = f"_{number}" if number else ""
        folder = tiles_folder / str(number)
        store, scale = paint_scene(
            scene, options, folder, workers, progress, tell, interruption, scheduler
        )
        unit = scene.calibration.unit
        turned = scene.map_from_painted
        told = replace(options, datum=options.datum or datums.get(estimates[0].fragment))
        grid = write_products(staging, suffix, store, scale, unit, turned, told, workers)
        if grid is not None:
            area += store.seen_pixels() * scale**2
            image, mask, small = overview(store, grid)
            drawing = draw_trajectory(image, mask, small, estimates, unit)
            write_image(staging / f"trajectory{suffix}.png", drawing)
    return area


def check_formats(options: ProductOptions) -> None:
    """Raise InputError when a library that a format needs is not there."""
    if "geotiff" in options.formats:
        geotiff.check_geotiff()


def write_products(
    folder: Path,
    suffix: str,
    store: TileStore,
    metres_per_pixel: float,
    unit: Unit,
    map_from_painted: Pose2,
    options: ProductOptions,
    workers: int,
) -> Grid | None:
    """Write a painted map in every format asked for; return its grid, None when it is empty."""
    grid = _extent(store, metres_per_pixel, options)
    if grid is None:
        return None
    check_png(grid, options)
    for name in options.formats:
        FORMATS[name](
            MapToWrite(folder, suffix, store, grid, unit, map_from_painted, options, workers)
        )
    return grid


def overview(store: TileStore, grid: Grid) -> tuple[UInt8Array, UInt8Array, Grid]:
    """Return a picture of a map for the eye, its mask and its grid, small however large the map."""
    factor = 1
    while max(grid.width, grid.height) > 2 * _OVERVIEW_PIXELS * factor and factor < 512:
        factor *= 2
    if factor > 1:
        grid = _aligned(grid)
    image, mask = store.overview(grid, factor)
    small = Grid(
        grid.x_min, grid.y_max, grid.metres_per_pixel * factor, image.shape[1], image.shape[0]
    )
    return image, mask, small


class MapToWrite:
    """A map to be written, with all that its writers ask for."""

    def __init__(
        self,
        folder: Path,
        suffix: str,
        store: TileStore,
        grid: Grid,
        unit: Unit,
        map_from_painted: Pose2,
        options: ProductOptions,
        workers: int,
    ) -> None:
        self.folder, self.suffix, self.store, self.grid = folder, suffix, store, grid
        self.unit, self.map_from_painted, self.options = unit, map_from_painted, options
        self.workers = workers

    def path(self, stem: str, ending: str) -> Path:
        """Return where one output of this map is written."""
        return self.folder / f"{stem}{self.suffix}{ending}"


def _write_png(what: MapToWrite) -> None:
    path = what.path("mosaic", ".png")
    _write_strips(what, path, _floor_strip)
    world_file.write_nav2_map(
        what.path("mosaic", ".yaml"), path.name, what.grid, what.unit, what.map_from_painted
    )
    if what.store.has_obstacles():
        _write_strips(what, what.path("obstacles", ".png"), _obstacle_strip)
    for name in what.options.layers:
        pixels = np.zeros((what.grid.height, what.grid.width), np.uint16)
        for row, column, tile in what.store.tiles(what.grid):
            put_part(pixels, _deep_gray(name, tile.layers[name]), row, column)
        write_image(what.path(name, ".png"), pixels)  # type: ignore[arg-type]
        world_file.write_world_file(what.path(name, ".pgw"), what.grid, what.map_from_painted)


def _write_strips(
    what: MapToWrite, path: Path, strip: Callable[[TileStore, Grid], png.Strip]
) -> None:
    grid, side = what.grid, tiles.TILE_PIXELS
    # Cut where tiles end, so that none is read twice.
    first = side - round(-grid.y_max / grid.metres_per_pixel) % side
    starts = [0, *range(first, grid.height, side)]
    ends = [*starts[1:], grid.height]
    parts = [
        grid.window(0, start, grid.width, end - start)
        for start, end in zip(starts, ends, strict=True)
    ]
    work = partial(strip, what.store)
    png.write_png(path, grid.width, grid.height, ordered(work, parts, what.workers))
    world_file.write_world_file(path.with_suffix(".pgw"), grid, what.map_from_painted)


def _floor_strip(store: TileStore, grid: Grid) -> png.Strip:
    return png.compress(world_file.transparent(*store.flatten(grid)))


def _obstacle_strip(store: TileStore, grid: Grid) -> png.Strip:
    layer = np.zeros((grid.height, grid.width, 4), np.uint8)
    for row, column, tile in store.tiles(grid):
        if tile.obstacles is not None:
            put_part(layer, tile.obstacles, row, column)
    return png.compress(layer)


def _write_geotiff(what: MapToWrite) -> None:
    shape = (what.grid.height, what.grid.width)
    transform = what.map_from_painted.matrix @ what.grid.metres_from_corner
    datum = what.options.datum
    if datum is not None:
        transform = Pose2(0.0, 0.0, datum.east_heading_radians).matrix @ transform

    def write(
        stem: str,
        bands: int,
        kind: str,
        pixels: Callable[[StoredTile], GenericArray | None],
        nodata: float | None,
    ) -> None:
        layout = geotiff.RasterLayout(shape, bands, kind, transform, datum, nodata)
        geotiff.write_geotiff(what.path(stem, ".tif"), layout, _blocks(what, pixels))

    write("mosaic", 4, "uint8", lambda tile: world_file.transparent(tile.image, tile.mask), None)
    if what.store.has_obstacles():
        write("obstacles", 4, "uint8", lambda tile: tile.obstacles, None)
    for name in what.options.layers:
        kind, nodata = _KINDS[name]
        write(name, 1, kind, lambda tile, name=name: tile.layers[name], nodata)  # type: ignore[misc]


def _write_deep_zoom(what: MapToWrite) -> None:
    grid = what.grid
    side = tiles.TILE_PIXELS
    aligned = _aligned(grid)
    margin = (
        round((aligned.y_max - grid.y_max) / grid.metres_per_pixel),
        round((grid.x_min - aligned.x_min) / grid.metres_per_pixel),
    )

    def cut() -> Iterator[tuple[int, int, UInt8Array]]:
        for row, column, tile in what.store.tiles(aligned):
            pixels = world_file.transparent(tile.image, tile.mask)
            if what.options.crop is not None:
                outside = np.ones(pixels.shape[:2], np.bool_)
                inside = np.zeros((grid.height, grid.width), np.bool_)
                put_part(outside, inside, margin[0] - row, margin[1] - column)
                pixels[outside] = 0
            yield row // side, column // side, pixels

    name = f"mosaic{what.suffix}"
    deepzoom.write_deep_zoom(what.folder, name, (aligned.width, aligned.height), side, cut())


def _write_nav2(what: MapToWrite) -> None:
    """Write free, occupied and unknown at a planner's resolution."""
    scale = what.grid.metres_per_pixel
    factor = 1
    while scale * factor * 2 <= what.options.nav_metres_per_pixel * (1 + 1e-9) and factor < 64:
        factor *= 2
    grid = _aligned(what.grid)
    image, mask = what.store.overview(grid, factor)
    gray = np.where(mask > 0, np.uint8(world_file.FREE_GRAY), np.uint8(world_file.UNKNOWN_GRAY))
    if what.options.nav_lines:
        gray[obstacles.line_cells(image, mask, scale * factor)] = world_file.OCCUPIED_GRAY
    else:
        for row, column, tile in what.store.tiles(grid):
            if tile.obstacles is not None:
                stands = obstacles.obstacle_cells(tile.obstacles, factor)
                part = gray[row // factor :, column // factor :][
                    : stands.shape[0], : stands.shape[1]
                ]
                part[stands] = world_file.OCCUPIED_GRAY
    seen = cv2.findNonZero((gray != world_file.UNKNOWN_GRAY).astype(np.uint8))
    left, top, width, height = cv2.boundingRect(seen)
    small = Grid(grid.x_min, grid.y_max, scale * factor, gray.shape[1], gray.shape[0])
    path = what.path("nav2", ".pgm")
    world_file.write_pgm(path, gray[top : top + height, left : left + width])
    world_file.write_nav2_map(
        what.path("nav2", ".yaml"),
        path.name,
        small.window(left, top, width, height),
        what.unit,
        what.map_from_painted,
    )


FORMATS: dict[str, Callable[[MapToWrite], None]] = {
    "png": _write_png,
    "geotiff": _write_geotiff,
    "deepzoom": _write_deep_zoom,
    "nav2": _write_nav2,
}


def _blocks(
    what: MapToWrite, pixels: Callable[[StoredTile], GenericArray | None]
) -> Iterator[tuple[int, int, GenericArray]]:
    for row, column, tile in what.store.tiles(what.grid):
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


def _extent(store: TileStore, metres_per_pixel: float, options: ProductOptions) -> Grid | None:
    """Return the smallest grid over all that was seen, or of it what the crop leaves."""
    bounds = store.bounds()
    if bounds is None:
        return None
    top, bottom, left, right = bounds
    scale = metres_per_pixel
    grid = Grid(left * scale, -top * scale, scale, right - left, bottom - top)
    return grid if options.crop is None else cropped(grid, options.crop)


def _aligned(grid: Grid) -> Grid:
    """Return the grid of whole tiles around another."""
    side = tiles.TILE_PIXELS
    left, top = (
        round(grid.x_min / grid.metres_per_pixel),
        round(-grid.y_max / grid.metres_per_pixel),
    )
    before, above = left % side, top % side
    width, height = -(-(grid.width + before) // side), -(-(grid.height + above) // side)
    return grid.window(-before, -above, width * side, height * side)
