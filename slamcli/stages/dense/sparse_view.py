"""Sparse views: of a frame's view only what tracking between keyframes compares is made.

Painting a view costs as much as all else that tracking takes, and most of its pixels are never
compared. The second level is painted at its own resolution; the finest is read from the frame's
picture at the places of a keyframe's points alone, as in sparse direct tracking (Forster et al.,
SVO, ICRA 2014). Where the picture is finer than the level, it is read between the two levels of its
own pyramid that are nearest in resolution (trilinear: Williams, Pyramidal parametrics, 1983).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array, UInt8Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.projection import sampling_map
from slamcli.core.camera.resolution import resolution_image
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Grid, Pose2, apply_homography
from slamcli.core.records import PyramidLevel, SampledLevel, SparseView, Template, View
from slamcli.stages.dense import pyramid

# The picture is smoothed as a level's detail is, by about a pixel; of the two levels around a
# resolution more weight is the finer one's by this much
# [benchmarks/streaming.py, errors of steps at 0, 0.25 and 0.5: asphalt 24, 17 and 20 um, course 81,
# 76 and 74 um].
_FINER_BY = 0.25
_MAX_HALVINGS = 4.0
# The window of the detail's high-pass, in pixels of the second level.
_HIGH_PASS_SIZE = (13, 13)


@dataclass(frozen=True, slots=True, eq=False)
class FloorReading:
    """Where a camera's pictures are read for sparse views; the same for all of its frames.

    Attributes
    ----------
    grid : Grid
        Of the finest level.
    level_masks : tuple of two LevelMask
        Of the finest level and of the second.
    places : (h, w, 3) float32
        Column and row of the picture at which each pixel of the finest level is seen, and how many
        times the picture is halved until it is as coarse.
    share : (h / 2, w / 2) float32
        Of the high-pass's window around a pixel of the second level, what is seen.
    most_halvings : int
        Of the picture, for the coarsest pixels.
    """

    grid: Grid
    level_masks: tuple[pyramid.LevelMask, pyramid.LevelMask]
    places: Float32Array
    share: Float32Array
    most_halvings: int

    @classmethod
    def of(
        cls, calibration: Calibration, grid: Grid, level_masks: Sequence[pyramid.LevelMask]
    ) -> FloorReading:
        """Return the reading of a calibrated camera's near view, with its level masks."""
        mapping = sampling_map(calibration, resolution_image(calibration), grid, Pose2())
        coarser = mapping.pixels_per_metre * np.float32(grid.metres_per_pixel)
        halvings = np.log2(np.maximum(coarser, 1.0)) - np.float32(_FINER_BY)
        halvings = np.clip(halvings, 0.0, _MAX_HALVINGS)
        places = np.dstack([mapping.columns, mapping.rows, halvings])
        # What is not seen is next to what is, and its place may be anywhere.
        places[mapping.pixels_per_metre <= 0] = 0.0
        share = np.asarray(cv2.blur(level_masks[1].seen, _HIGH_PASS_SIZE), np.float32)
        return cls(
            grid,
            (level_masks[0], level_masks[1]),
            np.ascontiguousarray(places, np.float32),
            np.maximum(share, np.float32(1e-3)),
            int(np.ceil(halvings.max())),
        )


def make_sparse_view(
    pictures: tuple[UInt8Array, ...], second: View, reading: FloorReading
) -> SparseView:
    """Return the sparse view of a gray picture (H, W).

    Parameters
    ----------
    pictures : tuple of (H, W) uint8
        From `smoothed_pictures`.
    second : View
        On the grid of the second level.
    reading : FloorReading
    """
    level_mask = reading.level_masks[1]
    level = pyramid.make_levels(second, (level_mask,))[0]
    brightness = cv2.multiply(pyramid.brightness_of(second.image), level_mask.seen)
    around = cv2.divide(cv2.blur(brightness, _HIGH_PASS_SIZE), reading.share)
    finest = SampledLevel(
        reading.grid.pixel_from_metres,
        reading.grid.metres_per_pixel,
        reading.level_masks[0].mask,
        reading.level_masks[0].inside,
        reading.places,
        pictures,
        pyramid.at_least_dark(np.asarray(around, np.float32)),
    )
    return SparseView(finest, level)


def smoothed_pictures(picture: UInt8Array, most: int) -> tuple[UInt8Array, ...]:
    """Return a gray picture (H, W), smoothed, and the same of it halved, up to so many times."""
    pictures = []
    for number in range(most + 1):
        if number > 0:
            picture = np.asarray(cv2.pyrDown(picture), np.uint8)
        pictures.append(np.asarray(cv2.GaussianBlur(picture, (3, 3), 0), np.uint8))
    return tuple(pictures)


def with_detail_of(level: PyramidLevel, finest: SampledLevel) -> PyramidLevel:
    """Return a view's finest level, its points with their detail in the sparse view of its frame.

    Frames are then compared by what was read alike: what painting smooths otherwise is no error
    of a motion [benchmarks/streaming.py, steps on asphalt: 19 um, 12 with it and all points].
    """
    template = level.template.value
    pixels = apply_homography(level.pixel_from_metres, template.points)
    slopes = template.slopes.copy()
    slopes[3] = detail_at(finest, pyramid.Places.of(pixels.T))
    return replace(level, template=Deferred.of(Template(template.points, slopes)))


def detail_at(level: PyramidLevel | SampledLevel, places: pyramid.Places) -> Float64Array:
    """Return (N,): a level's detail at some places."""
    if isinstance(level, PyramidLevel):
        return places.sample(level.detail)
    return _detail(level, places.maps).ravel()[places.chosen].astype(np.float64)


def slopes_at(
    level: PyramidLevel | SampledLevel, places: pyramid.Places
) -> tuple[Float64Array, Float64Array]:
    """Return (N,) twice: the slopes of a level's detail, per metre, along x (right) and y (up)."""
    if isinstance(level, PyramidLevel):
        right, up = pyramid.slopes(level.detail, level.metres_per_pixel)
        return places.sample(right), places.sample(up)
    # The mean around is the same one pixel on. All four neighbours at once: fewer, larger calls.
    columns, rows = (one.ravel()[places.chosen] for one in places.maps)
    ones, zeros = np.ones_like(columns), np.zeros_like(columns)
    shifts = np.array([[ones, -ones, zeros, zeros], [zeros, zeros, -ones, ones]])
    neighbours = pyramid.Places.of((np.stack([columns, rows])[:, None] + shifts).reshape(2, -1))
    brightness = _brightness(level, neighbours.maps).ravel()[neighbours.chosen].reshape(4, -1)
    around = _around(level, places.maps).ravel()[places.chosen]
    right, left, up, down = pyramid.contrast_of(brightness, around).astype(np.float64)
    span = 2.0 * level.metres_per_pixel
    return (right - left) / span, (up - down) / span


def _detail(level: SampledLevel, maps: Float32Array) -> Float32Array:
    """Return the detail of a sampled level at folded places (2, rows, columns) of its pixels."""
    return pyramid.contrast_of(_brightness(level, maps), _around(level, maps))


def _brightness(level: SampledLevel, maps: Float32Array) -> Float32Array:
    """Return the brightness of the frame's picture at folded places of a sampled level."""
    read_at = cv2.remap(level.places, maps[0], maps[1], cv2.INTER_LINEAR)
    columns, rows, halvings = (np.asarray(one, np.float32) for one in cv2.split(read_at))
    brightness = np.zeros(columns.shape, np.float32)
    for number, picture in enumerate(level.pictures):
        share = np.maximum(1.0 - np.abs(halvings - np.float32(number)), 0.0)
        if not share.any():
            continue
        # pyrDown keeps every other pixel.
        scale = np.float32(0.5**number)
        read = cv2.remap(picture, scale * columns, scale * rows, cv2.INTER_LINEAR)
        brightness += share * pyramid.brightness_of(np.asarray(read, np.uint8))
    return brightness


def _around(level: SampledLevel, maps: Float32Array) -> Float32Array:
    """Return the mean brightness around folded places of a sampled level."""
    half, border = np.float32(0.5), cv2.BORDER_REPLICATE
    columns, rows = half * maps[0], half * maps[1]
    around = cv2.remap(level.around, columns, rows, cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(around, np.float32)
