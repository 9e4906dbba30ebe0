"""Flights over a textured floor: states of a camera of varying height and tilt, and pictures."""

from __future__ import annotations

import math

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array, UInt8Array
from slamcli.survey.projection import STATES, project

SIZE, FOCAL = (256, 192), 300.0
RADIUS = 0.5 * math.hypot(*SIZE)


def floor_picture(side: int = 900, seed: int = 3) -> UInt8Array:
    """Return a floor with texture of several sizes."""
    generator = np.random.default_rng(seed)
    floor = np.zeros((side, side), np.float32)
    for size in (2, 5, 14, 40):
        noise = generator.standard_normal((side // size + 2, side // size + 2)).astype(np.float32)
        floor += cv2.resize(noise, (side, side), interpolation=cv2.INTER_CUBIC)
    scaled = cv2.normalize(floor, None, 0, 255, cv2.NORM_MINMAX)
    return np.asarray(scaled, np.uint8)


def nadir_states(rows: int, columns: int, generator: np.random.Generator) -> Float64Array:
    """Return the states of a serpentine with height +-10 %, tilt +-3 degrees, any heading."""
    states = np.zeros((rows * columns, STATES))
    for number in range(rows * columns):
        row, column = divmod(number, columns)
        along = column if row % 2 == 0 else columns - 1 - column
        states[number, :2] = 170 + 105 * along, -170 - 90 * row
    states[:, 2] = generator.uniform(-0.3, 0.3, len(states))
    states[:, 3] = np.log(generator.uniform(0.9, 1.1, len(states)))
    states[:, 4:] = np.radians(generator.uniform(-3.0, 3.0, (len(states), 2)))
    return states


def photographs(floor: UInt8Array, states: Float64Array) -> list[UInt8Array]:
    to_map = np.diag([1.0, -1.0, 1.0])
    middle = np.array([[1.0, 0.0, (SIZE[0] - 1) / 2], [0.0, 1.0, (SIZE[1] - 1) / 2], [0, 0, 1.0]])
    return [
        np.asarray(cv2.warpPerspective(floor, middle @ one @ to_map, SIZE), np.uint8)
        for one in project(states, FOCAL).image_from_map
    ]
