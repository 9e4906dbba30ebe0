"""The second walk: placed frames to finished tiles, whatever the map's size."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import default_metres_per_pixel, footprint_hull
from slamcli.core.camera.mounting import rocked
from slamcli.core.config import ProductOptions
from slamcli.core.errors import FrameError, InputError
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import PosedFrame, PoseEstimate, Tile
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.raster.tile_store import TileStore
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.run.paint.frame_cache import FrameCache, max_at_once, max_pictures, size_text
from slamcli.run.paint.thumbnails import Thumbnails, read_glimpse
from slamcli.run.session.executor import Progress, ordered
from slamcli.run.session.interruption import Interruption
from slamcli.stages.mosaic import exposure, tiles
from slamcli.stages.mosaic.exposure import Exposure, Shared
from slamcli.stages.mosaic.painter import Painter
from slamcli.stages.mosaic.sampling import SourceImage
from slamcli.stages.mosaic.tiles import TileKey

# Arrays of a tile that is being painted, at their most: its pixels, and the cells of each view.
_TILE_BYTES, _TILE_VIEW_BYTES = 60_000_000, 350_000
_STORED_TILE_BYTES = tiles.TILE_PIXELS**2 * 3 + tiles.TILE_PIXELS**2 // 8
_LAYER_BYTES = {"resolution": 4, "views": 2, "last-frame": 4}
# A PNG of more than this would not open in most viewers.
_MAX_PNG_PIXELS = 400_000_000
_PNG_BYTES_A_PIXEL = 5


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One connected map's frames, in the axes that it is painted in.

    Attributes
    ----------
    calibration : Calibration
        That the frames have in common.
    files : tuple of FrameFile
    shots : tuple of PosedFrame
        Of the same length.
    map_from_painted : Pose2
    glimpses : Thumbnails
        Of its frames, those that are at hand.
    """

    calibration: Calibration
    files: tuple[FrameFile, ...]
    shots: tuple[PosedFrame, ...]
    map_from_painted: Pose2
    thumbnails: Thumbnails


def scenes_of(
    calibration: Calibration,
    estimates: Sequence[PoseEstimate],
    file_of: Callable[[PoseEstimate], FrameFile],
    turn_radians: float,
    thumbnails: Thumbnails | None = None,
) -> list[tuple[Scene, list[PoseEstimate]]]:
    """Return what is painted: every fragment, with its frames.

    By the frames that are tracked: what a predicted one shows was of no use to place it.
    """
    scenes = []
    for members in placed_fragments(estimates).values():
        seen = [estimate for estimate in members if estimate.status == "tracked"]
        turn = Pose2(0.0, 0.0, turn_radians)
        shots = tuple(
            PosedFrame(
                e.index,
                turn @ e.map_from_robot if turn_radians else e.map_from_robot,
                calibration if e.rocking is None else rocked(calibration, e.rocking),
            )
            for e in seen
            if e.map_from_robot is not None
        )
        files = tuple(file_of(estimate) for estimate in seen)
        scene = Scene(calibration, files, shots, turn.inverse(), thumbnails or Thumbnails())
        scenes.append((scene, turned(members, scene)))
    return scenes


def turned(estimates: Sequence[PoseEstimate], scene: Scene) -> list[PoseEstimate]:
    """Return estimates in the axes that the scene is painted in."""
    painted = scene.map_from_painted.inverse()
    return [
        replace(one, map_from_robot=painted @ one.map_from_robot)
        for one in estimates
        if one.map_from_robot is not None
    ]


def paint_scene(
    scene: Scene,
    options: ProductOptions,
    folder: Path,
    workers: int,
    progress: Progress,
    tell: Callable[[str], None],
    interruption: Interruption,
    scheduler: str = "",
) -> tuple[TileStore, float]:
    """Paint a scene's tiles into a folder; those that it already holds are not painted again.

    Returns
    -------
    (TileStore, float)
        And the metres a pixel.

    Raises
    ------
    InputError
        When nothing is to be painted, or a memory limit leaves no room to paint in.
    OutputError
    """
    scale = options.paint.metres_per_pixel or default_metres_per_pixel(scene.calibration)
    store = TileStore(folder, tiles.TILE_PIXELS, options.layers)
    light = _light(scene, workers, progress, scheduler) if options.paint.gain else None
    paint = replace(options.paint, metres_per_pixel=scale)
    painter = Painter(scene.calibration, scale, paint, light)
    plan = [item for item in painter.plan(scene.shots) if _wanted(item[0], scale, options)]
    if not plan:
        raise InputError("no frame sees anything of that crop; poses.csv tells where they are")
    canvas = workers * _tile_bytes(plan)
    most = max_pictures(painter.picture_bytes, options.memory_bytes, canvas, workers)
    left = [(key, numbers) for key, numbers in plan if (key.row, key.column) not in store]
    uses = Counter(chain.from_iterable(numbers for _, numbers in left))
    pictures = FrameCache(partial(_picture, painter, scene), most, uses)
    work = partial(_paint, painter, scene, pictures)
    # First some of the middle, by whose time all the others' is foretold.
    middle = len(left) // 2
    left = left[middle : middle + workers] + left[:middle] + left[middle + workers :]
    started, done = time.perf_counter(), len(plan) - len(left)
    for number, ((key, _), tile) in enumerate(
        zip(left, ordered(work, left, workers, scheduler), strict=False), start=1
    ):
        store.put(key.row, key.column, tile)
        if number == min(workers, len(left)):
            seconds = (time.perf_counter() - started) * (len(left) - number) / number
            held = min(most, max_at_once([numbers for _, numbers in plan]))
            tell(estimate(painter, plan, options, held, seconds, workers))
        progress("painting", done + number, len(plan))
        if interruption.heeded():
            break
    return store, scale


def estimate(
    painter: Painter,
    plan: Sequence[tuple[TileKey, list[int]]],
    options: ProductOptions,
    pictures: int,
    seconds: float,
    workers: int,
) -> str:
    """Return a line on how large the map will be, and what painting it takes.

    Parameters
    ----------
    pictures : int
        Frames held in memory.
    seconds : float
        To paint, as the first tile foretells.
    """
    grid = tiles.extent_of([key for key, _ in plan], painter.metres_per_pixel)
    assert grid is not None
    layers = sum(_LAYER_BYTES[layer] for layer in options.layers) * tiles.TILE_PIXELS**2
    disk = len(plan) * (_STORED_TILE_BYTES + layers)
    memory = pictures * painter.picture_bytes + workers * _tile_bytes(plan)
    return (
        f"up to {grid.width}x{grid.height} pixels of {painter.metres_per_pixel:g} "
        f"{painter.calibration.unit}, {len(plan)} tiles; about {size_text(disk)} of disk, "
        f"{size_text(memory)} of memory, {seconds:.0f} s to paint"
    )


def _tile_bytes(plan: Sequence[tuple[TileKey, list[int]]]) -> int:
    """Return what the tile that most frames see takes while it is painted."""
    return _TILE_BYTES + _TILE_VIEW_BYTES * max(len(numbers) for _, numbers in plan)


def check_png(grid: Grid, options: ProductOptions) -> None:
    """Refuse a picture too large for one PNG, and say what would hold it."""
    pixels = grid.width * grid.height
    most = min(_MAX_PNG_PIXELS, options.memory_bytes // _PNG_BYTES_A_PIXEL)
    if "png" in options.formats and pixels > most:
        fitting = grid.metres_per_pixel * (pixels / most) ** 0.5
        raise InputError(
            f"the mosaic would have {grid.width}x{grid.height} pixels, too many for one PNG; use "
            f"--format geotiff or deepzoom, or --metres-per-pixel {fitting * 1.05:.2g} or more"
        )


def check_scene(scene: Scene, options: ProductOptions) -> None:
    """Refuse what cannot be written before anything is painted."""
    scale = options.paint.metres_per_pixel or default_metres_per_pixel(scene.calibration)
    painter = Painter(scene.calibration, scale)
    grid = painter.extent([shot.map_from_robot for shot in scene.shots])
    if options.crop is not None:
        grid = cropped(grid, options.crop)
    check_png(grid, options)


def cropped(grid: Grid, crop: tuple[float, float, float, float]) -> Grid:
    """Return the part of a grid that lies in x_min, y_min, x_max, y_max, on whole pixels of it."""
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


def _light(scene: Scene, workers: int, progress: Progress, scheduler: str) -> Exposure:
    hull = footprint_hull(scene.calibration)
    step = exposure.comparison_step(scene.calibration)
    work = partial(_observe, hull, step)
    observations = []
    jobs = (
        (file, shot, scene.thumbnails.take(file))
        for file, shot in zip(scene.files, scene.shots, strict=True)
    )
    for done, one in enumerate(ordered(work, jobs, workers, scheduler), start=1):
        observations.append(one)
        progress("comparing light", done, len(scene.files))
    return exposure.solve(observations)


def _observe(
    hull: Float64Array,
    step: float,
    job: tuple[FrameFile, PosedFrame, UInt8Array | None],
) -> Shared:
    file, shot, gray = job
    try:
        gray = read_glimpse(file) if gray is None else gray
    except FrameError:
        return exposure.nothing_shared()
    return exposure.observe(gray, shot.calibration, hull, shot.map_from_robot, step)


def _wanted(key: TileKey, scale: float, options: ProductOptions) -> bool:
    if options.crop is None:
        return True
    x_min, y_min, x_max, y_max = options.crop
    grid = tiles.tile_grid(key, scale)
    return grid.x_min < x_max and grid.x_max > x_min and grid.y_min < y_max and grid.y_max > y_min


def _picture(painter: Painter, scene: Scene, number: int) -> SourceImage:
    try:
        frame = read_frame(scene.files[number], halved=painter.halves)
    except FrameError:
        return painter.blank()
    return painter.picture(frame, number)


def _paint(
    painter: Painter, scene: Scene, pictures: FrameCache, item: tuple[TileKey, list[int]]
) -> Tile | None:
    key, numbers = item
    tile = painter.paint(key, scene.shots, numbers, pictures)
    pictures.done(numbers)
    return tile
