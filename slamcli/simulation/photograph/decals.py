"""Flat figures drawn over the floor, their edges exact to a small part of a ray."""

from __future__ import annotations

import numpy as np

from slamcli.core.arrays import Float32Array, Float64Array
from slamcli.simulation.photograph.world import Decal


def draw_decals(
    decals: tuple[Decal, ...],
    rays: Float32Array,
    world_from_image: Float64Array,
    picture: Float32Array,
) -> None:
    """Draw figures where (h, w, 2) rays meet them, mixed by the share of a ray that they cover.

    A figure with a corner behind the camera is left out.
    """
    image_from_world = np.linalg.inv(world_from_image)
    across = np.abs(rays[0, -1] - rays[0, 0]).max() / max(rays.shape[1] - 1, 1)
    down = np.abs(rays[-1, 0] - rays[0, 0]).max() / max(len(rays) - 1, 1)
    for decal in decals:
        ends = np.column_stack([decal.corners, np.ones(len(decal.corners))]) @ image_from_world.T
        if ends[:, 2].min() <= 0.0:
            continue
        cover = np.ones(rays.shape[:2], np.float32)
        for start, end in zip(ends, np.roll(ends, -1, axis=0), strict=True):
            # The edge as a line of the undistorted picture; the inside is where it is positive.
            line = np.cross(start, end)
            line *= -1.0 / np.hypot(line[0], line[1])
            distance = rays @ line[:2].astype(np.float32) + np.float32(line[2])
            wide = np.float32(abs(line[0]) * across + abs(line[1]) * down)
            cover *= np.clip(0.5 + distance / wide, 0.0, 1.0)
        picture += cover[..., None] * (np.float32(decal.gray) - picture)
