"""Frames painted a second time, from their final poses, tile by tile.

A tile is a pure function of the frames that see it. First every view is read coarsely, a cell at a
time, to decide which views show the floor and which one shows each spot best; only what those see
is then read at full resolution, once, straight from the camera's picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from slamcli.core.arrays import BoolArray, Int32Array, UInt8Array, UInt16Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.camera.projection import project_floor
from slamcli.core.camera.resolution import floor_sampling, resolution_image
from slamcli.core.config import PaintOptions
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import Frame, PosedFrame, Tile
from slamcli.stages.mosaic import blend, obstacles, sampling, tiles, view_consistency
from slamcli.stages.mosaic.blend import CellWindow, Views
from slamcli.stages.mosaic.exposure import Exposure
from slamcli.stages.mosaic.sampling import Sample, SourceImage
from slamcli.stages.mosaic.tiles import TileKey

# More views of one spot than this tell nothing new; the best of them are kept.
_MAX_VIEWS = 20
_FEW_VIEWS = 24
_PROBES = 9
# By this share of the range, views of one spot may lie apart: poses, tilt, bowed floors.
_DISPLACED_SHARE, _MAX_REACH_CELLS = 0.015, 4


class Painter:
    """Paints tiles of the map from frames with poses; may be shared by threads.

    Parameters
    ----------
    calibration : Calibration
        That frames have in common: lens and picture size. Where each stood over the floor, its
        `PosedFrame` tells.
    metres_per_pixel : float
        Of the map.
    options : PaintOptions
    light : Exposure or None
        From `exposure.solve`; None paints pictures as they are.

    Attributes
    ----------
    halves : bool
        Whether pictures of half the size do as well.
    """

    def __init__(
        self,
        calibration: Calibration,
        metres_per_pixel: float,
        options: PaintOptions | None = None,
        light: Exposure | None = None,
    ) -> None:
        self.calibration = calibration
        self.metres_per_pixel = metres_per_pixel
        self.options = options or PaintOptions()
        self.hull = footprint_hull(calibration)
        self._usable = sampling.border_fade(resolution_image(calibration))
        coarsest = metres_per_pixel * tiles.CELL_PIXELS
        self._depth = sampling.pyramid_depth(calibration, coarsest)
        self.halves = sampling.may_be_halved(calibration, metres_per_pixel)
        displaced = _DISPLACED_SHARE * calibration.max_range_metres / coarsest
        self._reach = min(_MAX_REACH_CELLS, max(1, round(displaced)))
        self._light = light
        self._brightening = sampling.brightening(
            calibration.image_size, light.vignetting if light else (0.0, 0.0)
        )

    @property
    def picture_bytes(self) -> int:
        """Memory that one frame takes while it is painted from."""
        width, height = self.calibration.image_size
        return width * height * 3 * 4 // (12 if self.halves else 3) + width * height

    def plan(self, shots: Sequence[PosedFrame]) -> list[tuple[TileKey, list[int]]]:
        """Return every tile that is seen, with the numbers of the shots that may see it.

        In the order in which the robot first came by, so that few pictures are needed at a time.
        """
        seen: dict[TileKey, list[int]] = {}
        for number, shot in enumerate(shots):
            outline = shot.map_from_robot.apply(self.hull)
            for key in tiles.tiles_under(outline, self.metres_per_pixel):
                seen.setdefault(key, []).append(number)
        return list(seen.items())

    def picture(self, frame: Frame, number: int) -> SourceImage:
        """Return a frame's pyramid, evenly lit.

        Parameters
        ----------
        frame : Frame
            Its picture whole, or of half the size where `halves` allows it.
        number : int
            Its shot's place in the sequence.
        """
        gain = float(self._light.gains[number]) if self._light else 1.0
        halved = frame.image.shape[1] < self.calibration.image_size[0]
        return sampling.make_picture(
            frame.image,
            self._usable,
            frame.mask,
            self._depth,
            gain,
            self._brightening,
            halvings=int(halved),
        )

    def blank(self) -> SourceImage:
        """Return a picture that shows nothing, for a frame that can no longer be read."""
        width, height = self.calibration.image_size
        hidden = np.zeros((height, width), np.uint8)
        return sampling.make_picture(hidden, hidden, None, self._depth)

    def paint(
        self,
        key: TileKey,
        shots: Sequence[PosedFrame],
        numbers: Sequence[int],
        pictures: Callable[[int], SourceImage],
    ) -> Tile | None:
        """Return one tile; None when no frame really sees any of it.

        Parameters
        ----------
        numbers : sequence of int
            Of the shots that may see the tile, from `plan`.
        pictures : function
            From a shot's number to what `picture` returned for it.
        """
        chosen = self._choose(key, shots, numbers)
        grid = tiles.cell_grid(key, self.metres_per_pixel)
        looks = [
            sampling.sample(
                pictures(number),
                shots[number].calibration,
                shots[number].map_from_robot,
                grid,
                smooth=False,
            )
            for number in chosen
        ]
        cells = np.stack([look.image for look in looks])
        weights = np.stack([look.weight for look in looks])
        shows_floor = weights > 0
        if self.options.obstacles:
            shows_floor = view_consistency.floor_views(cells, weights, self._reach)

        def read(place: int, window: CellWindow) -> Sample:
            shot = shots[chosen[place]]
            part = self._part(key, window)
            return sampling.sample(
                pictures(chosen[place]), shot.calibration, shot.map_from_robot, part
            )

        floor = np.where(shows_floor, weights, np.float32(0.0))
        views = blend.Views(cells, floor, read)
        blended = blend.BLENDS[self.options.blend](views)
        if not blended.pixels_per_metre.any():
            return None
        count, latest = _history(shows_floor, [shots[number].index for number in chosen])
        return Tile(
            tiles.tile_grid(key, self.metres_per_pixel),
            blended.image,
            blended.pixels_per_metre,
            _obstacles(blend.Views(cells, weights, read), shows_floor),
            np.where(blended.pixels_per_metre > 0, count, np.uint16(0)),
            np.where(blended.pixels_per_metre > 0, latest, np.int32(-1)),
        )

    def patch(
        self, frame: Frame, map_from_robot: Pose2, calibration: Calibration | None = None
    ) -> Sample:
        """Return what one frame shows of all that it sees, in the map, one resample away from it.

        The grid is that of `extent`.
        """
        picture = sampling.make_picture(frame.image, self._usable, frame.mask, self._depth)
        grid = self.extent([map_from_robot])
        return sampling.sample(picture, calibration or self.calibration, map_from_robot, grid)

    def extent(self, poses: Sequence[Pose2]) -> Grid:
        """Return the grid in the map that covers all that could be seen from (N >= 1) poses."""
        points = np.vstack([pose.apply(self.hull) for pose in poses])
        return Grid.covering(points, self.metres_per_pixel)

    def _part(self, key: TileKey, window: CellWindow) -> Grid:
        side = tiles.CELL_PIXELS
        return tiles.tile_grid(key, self.metres_per_pixel).window(
            window.column * side, window.row * side, window.width * side, window.height * side
        )

    def _choose(
        self, key: TileKey, shots: Sequence[PosedFrame], numbers: Sequence[int]
    ) -> list[int]:
        """Return the shots that are among the best anywhere in a tile, when there are many."""
        if len(numbers) <= _FEW_VIEWS:
            return list(numbers)
        grid = tiles.tile_grid(key, self.metres_per_pixel)
        share = np.linspace(0.0, 1.0, _PROBES)
        x, y = np.meshgrid(
            grid.x_min + share * (grid.x_max - grid.x_min),
            grid.y_min + share * (grid.y_max - grid.y_min),
        )
        probes = np.column_stack([x.ravel(), y.ravel()])
        pixels_per_metre = np.zeros((len(numbers), len(probes)))
        for place, number in enumerate(numbers):
            shot = shots[number]
            floor = shot.map_from_robot.inverse().apply(probes)
            _, seen = project_floor(shot.calibration, floor)
            sampled = floor_sampling(shot.calibration, floor[seen])
            pixels_per_metre[place, seen] = 1.0 / np.sqrt(sampled.prod(axis=1))
        rank = np.argsort(
            np.argsort(-pixels_per_metre, axis=0, kind="stable"), axis=0, kind="stable"
        )
        best = (rank < _MAX_VIEWS) & (pixels_per_metre > 0)
        # One that no probe sees may yet see a corner of the tile.
        kept = np.flatnonzero(best.any(axis=1) | ~pixels_per_metre.any(axis=1))
        return [numbers[int(place)] for place in kept]


def _history(shows_floor: BoolArray, indices: Sequence[int]) -> tuple[UInt16Array, Int32Array]:
    """Return how many views see each pixel of a tile, and the latest frame that does."""
    margin, side = tiles.MARGIN_CELLS, tiles.CELL_PIXELS
    inner = shows_floor[:, margin:-margin, margin:-margin]
    count = inner.sum(axis=0).astype(np.uint16)
    order = np.array(indices, np.int32)[:, None, None]
    latest = np.where(inner, order, np.int32(-1)).max(axis=0)
    return (
        count.repeat(side, axis=0).repeat(side, axis=1),
        latest.repeat(side, axis=0).repeat(side, axis=1),
    )


def _obstacles(views: Views, shows_floor: BoolArray) -> UInt8Array | None:
    """Return (h, w, 4) BGRA of what is not floor, from the view that sees it best; or None."""
    other = np.where(shows_floor, np.float32(0.0), views.weights)
    margin = tiles.MARGIN_CELLS
    inner = (slice(margin, -margin), slice(margin, -margin))
    if not other[:, *inner].any():
        return None
    floor = np.where(shows_floor, views.weights, np.float32(0.0)).sum(axis=0)[inner]
    stands = np.uint8(obstacles.STANDS_ALPHA), np.uint8(obstacles.PASSED_ALPHA)
    alpha = np.where(other.sum(axis=0)[inner] > floor, *stands)
    label = np.where(other.max(axis=0) > 0, other.argmax(axis=0), -1)[inner]
    side = tiles.CELL_PIXELS
    layer = np.zeros((tiles.TILE_PIXELS, tiles.TILE_PIXELS, 4), np.uint8)
    whole = blend.CellWindow(0, 0, *label.shape)
    for number in np.unique(label[label >= 0]):
        own = (label == number).repeat(side, axis=0).repeat(side, axis=1)
        shade = alpha.repeat(side, axis=0).repeat(side, axis=1)
        read = views.read(int(number), whole)
        layer[own] = np.dstack([read.image, shade])[own]
    return layer
