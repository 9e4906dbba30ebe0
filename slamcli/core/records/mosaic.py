"""Input and output of the mosaic: frames with their poses, and painted tiles."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import Float32Array, Int32Array, UInt8Array, UInt16Array
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
    """

    grid: Grid
    image: UInt8Array
    pixels_per_metre: Float32Array
    obstacles: UInt8Array | None
    views: UInt16Array
    latest: Int32Array
