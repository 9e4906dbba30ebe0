"""The simulated world: a floor, with boxes, decals and a room on it."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.simulation.floors import Floor


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A cuboid obstacle on the floor.

    Attributes
    ----------
    world_from_box : Pose2
        Of its centre, at stamp 0.
    size_metres : (float, float, float)
        Length, width, height.
    colour : (float, float, float)
        BGR of its top; the sides are darker.
    velocity : (float, float)
        Metres a second, in the world.
    """

    world_from_box: Pose2
    size_metres: tuple[float, float, float]
    colour: tuple[float, float, float]
    velocity: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Decal:
    """A flat, convex, plain figure on the floor, such as a calibration square.

    Attributes
    ----------
    corners : (N, 2) float64
        World metres, counter-clockwise.
    gray : float
        Encoded, 0 to 255.
    """

    corners: Float64Array
    gray: float


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A square room: four walls around the floor.

    Attributes
    ----------
    centre : (float, float)
        World metres.
    side_metres : float
    wall : Floor
        Its texture: x along the walls, all around, y up from the floor.
    """

    centre: tuple[float, float]
    side_metres: float
    wall: Floor


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Everything that a simulated camera can see.

    Attributes
    ----------
    floor : Floor
    boxes, decals : tuple
    room : Room or None
    """

    floor: Floor
    boxes: tuple[Box, ...] = ()
    decals: tuple[Decal, ...] = ()
    room: Room | None = None
