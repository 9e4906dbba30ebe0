"""Photographs of a simulated world: its objects, the camera, rendering and disturbances."""

from slamcli.simulation.photograph.camera import make_camera, texture_metres_per_pixel, tilted
from slamcli.simulation.photograph.frame import Photographer, take
from slamcli.simulation.photograph.world import Box, Decal, Room, World

__all__ = [
    "Box",
    "Decal",
    "Photographer",
    "Room",
    "World",
    "make_camera",
    "take",
    "texture_metres_per_pixel",
    "tilted",
]
