"""Periods of simulated floors: those that were laid, and none where nothing repeats."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import worlds
from floor_pictures import SIDE, square_grid

import slamcli
from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame, View
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import FloorOptions
from slamcli.stages import dense


def periods_of(kind: str, seed: int, count: int) -> list[Float64Array]:
    surface = FloorOptions(wear=0.0, tile_metres=0.1)
    world = photograph.World(floors.make_floor(kind, surface, 0.001, seed=seed))
    photographer = photograph.Photographer(world, photograph.make_camera(worlds.CAMERA))
    mapper = slamcli.Mapper(photographer.calibration)
    frames = [
        Frame(i, str(i), None, worlds.take(photographer, Pose2(0.1 * i, 0.05, 0.1 * i), i))
        for i in range(count)
    ]
    return [mapper.prepare(frame).repeats for frame in frames]


@pytest.mark.parametrize("seed", [4, 5])
def test_concrete_does_not_repeat(seed: int) -> None:
    """By the few pixels of the coarsest level alone, 2 views of 10 would repeat."""
    assert [len(shifts) for shifts in periods_of("concrete", seed, 10)] == [0] * 10


def test_tiles_repeat_by_their_side() -> None:
    for shifts in periods_of("tiles", 0, 4):
        lengths = np.linalg.norm(shifts, axis=1)
        assert np.any(np.abs(lengths - 0.1) < 0.012)


def test_a_weaker_pattern_within_a_tile_hides_no_period_of_the_tiles() -> None:
    """It has four shifts that are shorter: by these alone, all of a tile would be its marks."""
    generator = np.random.default_rng(1)
    within = np.tile(generator.normal(0.0, 30.0, (40, 40)), (SIDE // 40, SIDE // 40))
    tiles = np.tile(generator.normal(0.0, 22.0, (200, 200)), (SIDE // 200, SIDE // 200))
    floor = cv2.GaussianBlur(within + tiles, (0, 0), 6.0)
    picture = np.clip(128.0 + 30.0 * floor / floor.std(), 0, 255).astype(np.uint8)
    view = View(square_grid(SIDE), picture, np.full((SIDE, SIDE), 255, np.uint8))
    lengths = np.linalg.norm(dense.find_periods(dense.make_levels(view)), axis=1)
    assert len(lengths) == 4
    assert np.abs(lengths[:3] - 200.0).max() < 8.0
