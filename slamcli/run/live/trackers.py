"""What places the frames of a live camera: a mapper, or a follower in a finished map."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from slamcli.core.camera.calibration import Calibration
from slamcli.core.geometry import Grid
from slamcli.core.records import FloorMap, Frame, PoseEstimate, PreparedFrame
from slamcli.mapping.localizer import Follower, Locator
from slamcli.mapping.mapper import Mapper


@dataclass(frozen=True, slots=True, eq=False)
class Tracker:
    """Places frames, one after the other.

    Attributes
    ----------
    calibration : Calibration
    view : Grid
        Of the frames' bird's-eye views, in the robot frame.
    prepare : function
        Of a frame: makes it ready to be placed.
    place : function
        Of a prepared frame: where it is, or why that is not known.
    floor_map : function
        Of nothing: the map so far; None where there is none yet.
    maps : bool
        Whether the map grows, and its poses may move.
    """

    calibration: Calibration
    view: Grid
    prepare: Callable[[Frame], PreparedFrame]
    place: Callable[[PreparedFrame], PoseEstimate]
    floor_map: Callable[[], FloorMap | None]
    maps: bool


def mapping(mapper: Mapper) -> Tracker:
    """Return a tracker that maps while it locates."""
    return Tracker(
        mapper.calibration, mapper.grid, mapper.prepare, mapper.step, mapper.floor_map, maps=True
    )


def locating(floor_map: FloorMap) -> Tracker:
    """Return a tracker that follows a robot in a finished map."""
    locator = Locator(floor_map)
    place = Follower(locator).place
    return Tracker(
        locator.calibration, locator.grid, locator.prepare, place, lambda: floor_map, maps=False
    )
