"""The painter: tiles of the mosaic resampled from the frames at their final poses.

A tile is a pure function of the frames that see it. First every view is read coarsely, a cell at a
time, to decide which views show the floor and which one shows each spot best; only what those see
is then read at full resolution, in one interpolation of the camera's image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from slamcli.core.arrays import BoolArray, Float64Array, Int32Array, UInt8Array, UInt16Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import footprint_hull
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.config import PaintOptions
from slamcli.core.geometry import Grid, Pose2
from slamcli.core.records import FloorEvidence, Frame, PosedFrame, Tile
from slamcli.stages.mosaic import blend, obstacles, occupancy, source_image, tiles, view_consistency
from slamcli.stages.mosaic.blend import CellWindow, Views
from slamcli.stages.mosaic.exposure import Exposure
from slamcli.stages.mosaic.sampling import Sample, sample_image
from slamcli.stages.mosaic.source_image import SourceImage
from slamcli.stages.mosaic.tiles import TileKey
from slamcli.stages.mosaic.view_selection import select_views

# Views of one spot may lie this share of the range apart, by errors of poses and tilt and by bowed
# floors; the limit bounds what is lost of narrow obstacles [guarded by benchmarks/blends.py].
_DISPLACED_SHARE, _MAX_REACH_CELLS = 0.015, 4


class Painter:
    """Painter of map tiles from posed frames; may be shared by threads.

    Parameters
    ----------
    calibration : Calibration
        What frames have in common: lens and image size. Tilt and height of each are those of its
        `PosedFrame`.
    metres_per_pixel : float
        Of the map.
    options : PaintOptions
    exposure : Exposure or None
        From `exposure.estimate_exposure`; None paints images as they are.
    evidence : bool
        Whether tiles have what their occupancy is found by.

    Attributes
    ----------
    halves : bool
        Whether images of half the size do as well.
    """

    def __init__(
        self,
        calibration: Calibration,
        metres_per_pixel: float,
        options: PaintOptions | None = None,
        exposure: Exposure | None = None,
        *,
        evidence: bool = False,
    ) -> None:
        self.calibration = calibration
        self.metres_per_pixel = metres_per_pixel
        self.options = options or PaintOptions()
        self.hull = footprint_hull(calibration)
        self._usable = source_image.border_fade(resolution_image(calibration))
        coarsest = metres_per_pixel * tiles.CELL_PIXELS
        self._depth = source_image.pyramid_depth(calibration, coarsest)
        self.halves = source_image.may_be_halved(calibration, metres_per_pixel)
        displaced = _DISPLACED_SHARE * calibration.max_range_metres / coarsest
        self._reach = min(_MAX_REACH_CELLS, max(1, round(displaced)))
        self._exposure = exposure
        self.evidence = evidence
        self._brightening = source_image.brightening(
            calibration.image_size, exposure.vignetting if exposure else (0.0, 0.0)
        )

    @property
    def picture_bytes(self) -> int:
        """Memory in bytes that one frame takes while it is painted from."""
        width, height = self.calibration.image_size
        return width * height * 3 * 4 // (12 if self.halves else 3) + width * height

    def plan(self, posed_frames: Sequence[PosedFrame]) -> list[tuple[TileKey, list[int]]]:
        """Return every tile that is seen, with the indices of the posed frames that it is made of.

        In the order in which the robot first passed, so that few images are needed at a time.
        """
        seen: dict[TileKey, list[int]] = {}
        for number, posed in enumerate(posed_frames):
            outline = posed.map_from_robot.apply(self._hull_of(posed.calibration))
            for key in tiles.tiles_under(outline, self.metres_per_pixel):
                seen.setdefault(key, []).append(number)
        return select_views(list(seen.items()), posed_frames, self.metres_per_pixel)

    def picture(self, frame: Frame, number: int) -> SourceImage:
        """Return a frame's pyramid, with what compensates its exposure.

        Parameters
        ----------
        frame : Frame
            Its image whole, or of half the size where `halves` allows it.
        number : int
            Index of its posed frame in the sequence.
        """
        gain = float(self._exposure.gains[number]) if self._exposure else 1.0
        halved = frame.image.shape[1] < self.calibration.image_size[0]
        return source_image.make_source_image(
            frame.image,
            self._usable,
            frame.mask,
            self._depth,
            gain,
            self._brightening,
            halvings=int(halved),
        )

    def blank(self) -> SourceImage:
        """Return an image that shows nothing, for a frame that can no longer be read."""
        width, height = self.calibration.image_size
        hidden = np.zeros((height, width), np.uint8)
        return source_image.make_source_image(hidden, hidden, None, self._depth)

    def paint(
        self,
        key: TileKey,
        posed_frames: Sequence[PosedFrame],
        numbers: Sequence[int],
        pictures: Callable[[int], SourceImage],
    ) -> Tile | None:
        """Return one tile; None when no frame really sees any of it.

        Parameters
        ----------
        numbers : sequence of int
            Indices of the posed frames that the tile is made of, from `plan`.
        pictures : function
            From such an index to what `picture` returned for it.
        """

        def sample(number: int, grid: Grid, *, smooth: bool) -> Sample:
            posed = posed_frames[number]
            source, pose = pictures(number), posed.map_from_robot
            return sample_image(source, posed.calibration, pose, grid, smooth=smooth)

        def read(index: int, window: CellWindow) -> Sample:
            return sample(numbers[index], self._part(key, window), smooth=True)

        grid = tiles.cell_grid(key, self.metres_per_pixel)
        coarse = [sample(number, grid, smooth=False) for number in numbers]
        cells = np.stack([one.image for one in coarse])
        views = Views(cells, np.stack([one.weight for one in coarse]), read)
        shows_floor = views.weights > 0
        if self.options.obstacles:
            shows_floor = view_consistency.floor_views(cells, views.weights, self._reach)
        floor = np.where(shows_floor, views.weights, np.float32(0.0))
        blended = blend.BLENDS[self.options.blend](replace(views, weights=floor))
        resolution = blended.pixels_per_metre
        if not resolution.any():
            return None
        count, latest = _history(shows_floor, [posed_frames[number].index for number in numbers])
        return Tile(
            tiles.tile_grid(key, self.metres_per_pixel),
            blended.image,
            resolution,
            _obstacles(views, shows_floor),
            np.where(resolution > 0, count, np.uint16(0)),
            np.where(resolution > 0, latest, np.int32(-1)),
            self._evidence(views, [posed_frames[number] for number in numbers]),
        )

    def _evidence(self, views: Views, posed: Sequence[PosedFrame]) -> FloorEvidence | None:
        if not self.evidence:
            return None
        positions = np.array([(one.map_from_robot.x, one.map_from_robot.y) for one in posed])
        found = occupancy.floor_evidence(views.cells, views.weights, positions)
        margin = tiles.MARGIN_CELLS
        inner = (slice(margin, -margin), slice(margin, -margin))
        return FloorEvidence(
            found.baseline_metres[inner], found.texture_gray[inner], found.differs[inner]
        )

    def patch(
        self, frame: Frame, map_from_robot: Pose2, calibration: Calibration | None = None
    ) -> Sample:
        """Return what one frame shows of all that it sees, in the map, in one interpolation.

        The grid is that of `extent`.
        """
        source = source_image.make_source_image(frame.image, self._usable, frame.mask, self._depth)
        grid = self.extent([map_from_robot])
        return sample_image(source, calibration or self.calibration, map_from_robot, grid)

    def extent_of(self, posed_frames: Sequence[PosedFrame]) -> Grid:
        """Return the grid in the map that covers all that (N >= 1) posed frames could see."""
        points = [one.map_from_robot.apply(self._hull_of(one.calibration)) for one in posed_frames]
        return Grid.covering(np.vstack(points), self.metres_per_pixel)

    def extent(self, poses: Sequence[Pose2]) -> Grid:
        """Return the grid in the map that covers all that could be seen from (N >= 1) poses."""
        points = np.vstack([pose.apply(self.hull) for pose in poses])
        return Grid.covering(points, self.metres_per_pixel)

    def _hull_of(self, calibration: Calibration) -> Float64Array:
        """Return the outline of the floor that a frame sees, which height and tilt change."""
        return footprint_hull(calibration) if calibration.is_top_down else self.hull

    def _part(self, key: TileKey, window: CellWindow) -> Grid:
        side = tiles.CELL_PIXELS
        return tiles.tile_grid(key, self.metres_per_pixel).window(
            window.column * side, window.row * side, window.width * side, window.height * side
        )


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
    alphas = np.uint8(obstacles.PERMANENT_ALPHA), np.uint8(obstacles.PASSED_ALPHA)
    alpha = np.where(other.sum(axis=0)[inner] > floor, *alphas)
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
