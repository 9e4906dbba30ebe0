"""Photographs of a simulated world: its objects, the camera, rendering and disturbances."""

from slamcli.simulation.photograph.camera import make_camera, texture_metres_per_pixel, tilted
from slamcli.simulation.photograph.frame import Photographer, take
from slamcli.simulation.photograph.render import Shutter
from slamcli.simulation.photograph.world import Box, Decal, Room, World

__all__ = [
    "Box",
    "Decal",
    "Photographer",
    "Room",
    "Shutter",
    "World",
    "make_camera",
    "take",
    "texture_metres_per_pixel",
    "tilted",
]
