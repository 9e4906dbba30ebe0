"""The second pass over the frames: a scene, from its final poses, to tiles on disk."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from pathlib import Path

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import default_metres_per_pixel, footprint_hull
from slamcli.core.config import ProductOptions
from slamcli.core.errors import FrameError, InputError
from slamcli.core.records import Frame, PosedFrame, Tile
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.raster.tile_store import TileStore
from slamcli.run.paint import budget
from slamcli.run.paint.frame_cache import FrameCache
from slamcli.run.paint.scene import Scene
from slamcli.run.paint.thumbnails import read_thumbnail
from slamcli.run.session.session import Session
from slamcli.stages.mosaic import exposure, tiles
from slamcli.stages.mosaic.exposure import Exposure, FloorBrightness
from slamcli.stages.mosaic.painter import Painter
from slamcli.stages.mosaic.source_image import SourceImage
from slamcli.stages.mosaic.tiles import TileKey


def make_painter(calibration: Calibration, options: ProductOptions) -> Painter:
    """Return the painter of a camera's frames, as they are lit, at the scale of the map."""
    default = default_metres_per_pixel
    scale = options.paint.metres_per_pixel or default(calibration)
    evidence = "nav2" in options.formats and not options.nav_lines
    return Painter(calibration, scale, options.paint, evidence=evidence)


def paint_scene(
    scene: Scene, painter: Painter, options: ProductOptions, folder: Path, session: Session
) -> tuple[TileStore, set[str]]:
    """Paint a scene's tiles into a folder; those that it already holds are not painted again.

    Returns
    -------
    (TileStore, set of str)
        And the names of frames that could not be read again.

    Raises
    ------
    InputError
        When nothing is to be painted, or a memory limit leaves no room to paint in.
    OutputError
    """
    store = TileStore(folder, tiles.TILE_PIXELS, options.layers)
    dark, whole = set[int](), painter.plan(scene.shots)
    if options.paint.gain:
        painted = sorted(set(chain.from_iterable(numbers for _, numbers in whole)))
        light, dark = _exposure(scene, painted, session)
        painter = Painter(
            scene.calibration,
            painter.metres_per_pixel,
            options.paint,
            light,
            evidence=painter.evidence,
        )
    plan = [item for item in whole if _wanted(item[0], painter.metres_per_pixel, options)]
    if not plan:
        raise InputError("no frame sees anything of that crop; poses.csv lists where they are")
    workers = session.workers
    canvas_bytes = workers * budget.tile_bytes(plan)
    pictures = budget.max_pictures(
        painter.picture_bytes, options.memory_bytes, canvas_bytes, workers
    )
    left = [(key, numbers) for key, numbers in plan if (key.row, key.column) not in store]
    reader = _PictureReader(painter, scene.files, scene.keep_picture)
    uses = Counter(chain.from_iterable(numbers for _, numbers in left))
    work = partial(_paint, painter, scene.shots, reader, FrameCache(reader, pictures, uses))
    # First some of the middle: their time predicts that of all.
    middle = len(left) // 2
    left = left[middle : middle + workers] + left[:middle] + left[middle + workers :]
    started, before, unread = time.perf_counter(), len(plan) - len(left), set(dark)
    for number, ((key, _), (tile, missing)) in enumerate(
        zip(left, session.ordered(work, left), strict=False), start=1
    ):
        # Its pixels, or its light by those of all frames, are others once the frames are back.
        store.put(key.row, key.column, tile, finished=not (dark or missing))
        unread |= missing
        if number == min(workers, len(left)):
            seconds = (time.perf_counter() - started) * (len(left) - number) / number
            size = budget.estimate(painter, plan, options, pictures, workers)
            session.notify(f"{size}, {seconds:.0f} s to paint")
        session.progress("painting", before + number, len(plan))
        if session.interruption.stops_here():
            break
    return store, {scene.files[number].name for number in unread}


class _PictureReader:
    """Frames decoded a second time, as the painter's pictures.

    Attributes
    ----------
    unread : set of int
        Numbers of the frames that could not be; their pictures are blank.
    """

    def __init__(
        self,
        painter: Painter,
        files: Sequence[FrameFile],
        keep_picture: Callable[[Frame], None] | None,
    ) -> None:
        self._painter = painter
        self._files = files
        self._keep_picture = keep_picture if painter.halves else None
        self.unread: set[int] = set()

    def __call__(self, number: int) -> SourceImage:
        try:
            frame = read_frame(self._files[number], halved=self._painter.halves)
        except FrameError:
            self.unread.add(number)
            return self._painter.blank()
        if self._keep_picture is not None:
            self._keep_picture(frame)
        return self._painter.picture(frame, number)


def _paint(
    painter: Painter,
    shots: Sequence[PosedFrame],
    reader: _PictureReader,
    pictures: FrameCache,
    item: tuple[TileKey, list[int]],
) -> tuple[Tile | None, set[int]]:
    """Return a tile, and the numbers of its frames that could not be read."""
    key, numbers = item
    tile = painter.paint(key, shots, numbers, pictures)
    pictures.done(numbers)
    return tile, reader.unread.intersection(numbers)


def _exposure(scene: Scene, painted: Sequence[int], session: Session) -> tuple[Exposure, set[int]]:
    """Return every frame's gain and the vignetting, from floor that several frames show.

    And the numbers of the frames that could not be read.

    Parameters
    ----------
    painted : sequence of int
        Numbers of the frames that the map is painted from, which alone are compared.
    """
    hull = footprint_hull(scene.calibration)
    step = exposure.comparison_step(scene.calibration)
    work = partial(_observe, hull, step)
    observations, unread = [exposure.no_brightness()] * len(scene.files), set[int]()
    jobs = (
        (scene.files[number], scene.shots[number], scene.thumbnails.take(scene.files[number]))
        for number in painted
    )
    found = session.ordered(work, jobs)
    for done, (number, one) in enumerate(zip(painted, found, strict=True), start=1):
        if one is None:
            unread.add(number)
        else:
            observations[number] = one
        session.progress("comparing light", done, len(painted))
    return exposure.estimate_exposure(observations), unread


def _observe(
    hull: Float64Array,
    step: float,
    job: tuple[FrameFile, PosedFrame, UInt8Array | None],
) -> FloorBrightness | None:
    """Return the floor's brightness in a frame; None when it cannot be read."""
    file, shot, gray = job
    try:
        gray = read_thumbnail(file) if gray is None else gray
    except FrameError:
        return None
    if shot.calibration.is_top_down:
        hull = footprint_hull(shot.calibration)
    return exposure.observe(gray, shot.calibration, hull, shot.map_from_robot, step)


def _wanted(key: TileKey, scale: float, options: ProductOptions) -> bool:
    """Return whether a tile has a part in the crop."""
    if options.crop is None:
        return True
    x_min, y_min, x_max, y_max = options.crop
    grid = tiles.tile_grid(key, scale)
    return grid.x_min < x_max and grid.x_max > x_min and grid.y_min < y_max and grid.y_max > y_min
