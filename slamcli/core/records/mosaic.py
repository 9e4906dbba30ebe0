"""Input and output of the mosaic: frames with their poses, and painted tiles."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import BoolArray, Float32Array, Int32Array, UInt8Array, UInt16Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Grid, Pose2


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrame:
    """A frame with its pose, ready to be painted.

    Attributes
    ----------
    index : int
        Of the frame.
    map_from_robot : Pose2
    calibration : Calibration
        Of this frame: tilt and height may differ from the others'; lens and picture size may not.
    """

    index: int
    map_from_robot: Pose2
    calibration: Calibration


@dataclass(frozen=True, slots=True, eq=False)
class FloorEvidence:
    """What views say about cells of the map being floor.

    Attributes
    ----------
    baseline_metres : (h, w) float32
        How far the cameras of the views that agree are apart; -1 where nothing was seen.
    texture_gray : (h, w) float32
        Standard deviation of what most views show about a cell; nan at the border of what was seen.
    differs : (h, w) bool
        Whether some view shows something else.
    """

    baseline_metres: Float32Array
    texture_gray: Float32Array
    differs: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A painted piece of the map.

    Attributes
    ----------
    grid : Grid
        In the map frame.
    image : (h, w, 3) uint8, BGR
    pixels_per_metre : (h, w) float32
        Pixels of a picture to a metre of floor, in the view that saw the floor best; 0 where
        nothing was seen.
    obstacles : (h, w, 4) uint8 BGRA or None
        Pictures of obstacles: opaque where they are permanent, half transparent where they were for
        a time only; None when there are none.
    views : (h, w) uint16
        How many frames saw the floor here, of those that were compared.
    latest : (h, w) int32
        Index of the last frame that did; -1 for none.
    evidence : FloorEvidence or None
        Of the tile's cells; None where it is not needed.
    """

    grid: Grid
    image: UInt8Array
    pixels_per_metre: Float32Array
    obstacles: UInt8Array | None
    views: UInt16Array
    latest: Int32Array
    evidence: FloorEvidence | None = None
