"""The outputs of a map: every scene painted, then written in each format, with its trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import check_metres_per_pixel
from slamcli.core.config import ProductOptions
from slamcli.core.errors import InputError
from slamcli.core.geometry import Grid, pose_array
from slamcli.drawing.trajectory import draw_trajectory
from slamcli.io.files import write_drawing
from slamcli.io.raster import geotiff
from slamcli.io.raster.tile_store import TileStore
from slamcli.run.paint.formats import FORMATS
from slamcli.run.paint.map_to_write import MapToWrite
from slamcli.run.paint.paint import make_painter, paint_scene
from slamcli.run.paint.scene import Scene
from slamcli.run.session.session import Session
from slamcli.stages.geodesy import check_crs
from slamcli.stages.mosaic import tiles
from slamcli.stages.mosaic.painter import Painter

PRODUCTS = (
    "mosaic*.png",
    "mosaic*.yaml",
    "mosaic*.pgw",
    "mosaic*.tif",
    "mosaic*.dzi",
    "mosaic*.dzi.json",
    "mosaic*_files",
    "obstacles*.png",
    "obstacles*.pgw",
    "obstacles*.tif",
    "obstacles*.geojson",
    "trajectory*.png",
    "nav2*.pgm",
    "nav2*.yaml",
    "resolution*.*",
    "views*.*",
    "last-frame*.*",
)
# A PNG of more than this would not open in most viewers.
_MAX_PNG_PIXELS = 400_000_000
_PNG_BYTES_A_PIXEL = 5
_MAX_NAMED = 5
# Of the floor that one frame sees; a map may have far more.
_MAX_VIEW_PIXELS = 2**30
_OVERVIEW_PIXELS, _MAX_OVERVIEW_FACTOR = 1600, 512
# Unseen floor in an overview: the page that shows it has this background.
_UNSEEN_GRAY = 236


@dataclass(frozen=True, slots=True, eq=False)
class Overview:
    """A small picture of a painted map.

    Attributes
    ----------
    image : (h, w, 3) uint8, BGR
    grid : Grid
        In the axes that the map is painted in.
    turn_radians : float
        From the map's axes to those.
    """

    image: UInt8Array
    grid: Grid
    turn_radians: float = 0.0


@dataclass(frozen=True, slots=True)
class PaintedMaps:
    """Result of painting.

    Attributes
    ----------
    area_square_metres : float
        Of the floor seen, over all maps.
    unread : tuple of str
        Names of frames that have a pose but could not be read again.
    unshown : tuple of str
        Names of such frames that report.html shows no picture of.
    overviews : tuple of Overview or None
        Of the maps, in their order; None for one of which nothing was seen.
    """

    area_square_metres: float
    unread: tuple[str, ...]
    overviews: tuple[Overview | None, ...] = ()
    unshown: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """The line for the user that names the frames which could not be read again, or ""."""
        gone = "vanished or changed since they were located"
        if self.unread:
            return f"incomplete: {counted(self.unread)} not painted: {gone}"
        if self.unshown:
            return f"incomplete: {counted(self.unshown)} not shown in report.html: {gone}"
        return ""


def write_maps(
    scenes: Sequence[Scene],
    options: ProductOptions,
    staging: Path,
    tiles_folder: Path,
    session: Session,
) -> PaintedMaps:
    """Paint every connected map and write it in the formats of the options.

    The first is ``mosaic``, the next ``mosaic_1`` and so on. When the user interrupts, the tiles
    painted by then are written.

    Raises
    ------
    InputError, OutputError
    """
    painters = [make_painter(scene.calibration, options) for scene in scenes]
    for scene, painter in zip(scenes, painters, strict=True):
        _check_size(scene, painter, options)
    area, unread, overviews = 0.0, set[str](), list[Overview | None]()
    here = session.on_this_machine()
    for number, (scene, painter) in enumerate(zip(scenes, painters, strict=True)):
        store, missing = paint_scene(scene, painter, options, tiles_folder / str(number), session)
        unread |= missing
        grid = _extent(store, painter.metres_per_pixel, options)
        overview = None
        if grid is not None:
            suffix = f"_{number}" if number else ""
            given = replace(options, datum=scene.datum)
            poses = [e.map_from_robot for e in scene.estimates if e.map_from_robot is not None]
            output = MapToWrite(
                staging,
                suffix,
                store,
                grid,
                scene.map_from_painted,
                given,
                here,
                scene.calibration,
                pose_array(poses)[:, :2],
            )
            overview = _write_map(output, scene)
            area += store.seen_pixels() * painter.metres_per_pixel**2
        overviews.append(overview)
    return PaintedMaps(area, tuple(sorted(unread)), tuple(overviews))


def counted(names: Sequence[str]) -> str:
    """Return how many frames these are, and the first of their names."""
    shown = ", ".join(names[:_MAX_NAMED]) + (", ..." if len(names) > _MAX_NAMED else "")
    return f"{len(names)} frame{'s' if len(names) > 1 else ''} ({shown})"


def check_products(options: ProductOptions, calibration: Calibration) -> None:
    """Raise InputError when a library is not there, or the camera has no such resolution."""
    if options.paint.metres_per_pixel is not None:
        check_metres_per_pixel(calibration, options.paint.metres_per_pixel, _MAX_VIEW_PIXELS)
    if "geotiff" in options.all_formats:
        geotiff.check_geotiff()
        check_crs(options.crs)


def _write_map(output: MapToWrite, scene: Scene) -> Overview:
    """Write a map in every format, and the trajectory drawn over it; return its overview."""
    _check_png(output.grid, output.options)
    for name in output.options.all_formats:
        FORMATS[name](output)
    grid, factor, side = output.grid, 1, max(output.grid.width, output.grid.height)
    while side > 2 * _OVERVIEW_PIXELS * factor and factor < _MAX_OVERVIEW_FACTOR:
        factor *= 2
    if factor > 1:
        grid = tiles.whole_tiles(grid)
    image, mask = output.store.overview(grid, factor)
    height, width = mask.shape
    small = Grid(grid.x_min, grid.y_max, grid.metres_per_pixel * factor, width, height)
    drawing = draw_trajectory(image, mask, small, scene.estimates, output.unit)
    write_drawing(output.path("trajectory", ".png"), drawing)
    return _overview(image, mask, small, -output.map_from_painted.theta)


def _overview(image: UInt8Array, mask: UInt8Array, grid: Grid, turn_radians: float) -> Overview:
    """Return a map on the background of the page, of a size that it shows at once."""
    visible = np.full_like(image, _UNSEEN_GRAY)
    cv2.copyTo(image, mask, visible)
    scale = min(1.0, _OVERVIEW_PIXELS / max(grid.width, grid.height))
    size = max(1, round(scale * grid.width)), max(1, round(scale * grid.height))
    small = np.asarray(cv2.resize(visible, size, interpolation=cv2.INTER_AREA), np.uint8)
    grid = Grid(grid.x_min, grid.y_max, grid.metres_per_pixel / scale, *size)
    return Overview(small, grid, turn_radians)


def _check_size(scene: Scene, painter: Painter, options: ProductOptions) -> None:
    """Refuse, before anything is painted, what could not be written afterwards."""
    grid = painter.extent_of(scene.shots)
    _check_png(grid if options.crop is None else _cropped(grid, options.crop), options)


def _check_png(grid: Grid, options: ProductOptions) -> None:
    """Refuse a picture too large for one PNG, and name what would do."""
    pixels = grid.width * grid.height
    max_pixels = min(_MAX_PNG_PIXELS, options.memory_bytes // _PNG_BYTES_A_PIXEL)
    if "png" in options.formats and pixels > max_pixels:
        fitting = grid.metres_per_pixel * (pixels / max_pixels) ** 0.5
        raise InputError(
            f"the mosaic would have {grid.width}x{grid.height} pixels, too many for one PNG; use "
            f"--format geotiff or deepzoom, or --metres-per-pixel {fitting * 1.05:.2g} or more"
        )


def _extent(store: TileStore, metres_per_pixel: float, options: ProductOptions) -> Grid | None:
    """Return the smallest grid over all floor seen, or its part in the crop; None without any."""
    bounds = store.bounds()
    if bounds is None:
        return None
    top, bottom, left, right = bounds
    scale = metres_per_pixel
    grid = Grid(left * scale, -top * scale, scale, right - left, bottom - top)
    return grid if options.crop is None else _cropped(grid, options.crop)


def _cropped(grid: Grid, crop: tuple[float, float, float, float]) -> Grid:
    """Return the part of a grid in x_min, y_min, x_max, y_max (metres), on whole pixels of it."""
    scale = grid.metres_per_pixel
    left = max(0, round((crop[0] - grid.x_min) / scale))
    top = max(0, round((grid.y_max - crop[3]) / scale))
    right = min(grid.width, round((crop[2] - grid.x_min) / scale))
    bottom = min(grid.height, round((grid.y_max - crop[1]) / scale))
    if right <= left or bottom <= top:
        raise InputError(
            f"nothing of the map lies in that crop: it spans x {grid.x_min:.3f} to "
            f"{grid.x_max:.3f}, y {grid.y_min:.3f} to {grid.y_max:.3f}"
        )
    return grid.window(left, top, right - left, bottom - top)
