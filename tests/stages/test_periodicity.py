"""Periods of simulated floors: those that were laid, and none where nothing repeats."""

from __future__ import annotations

import numpy as np
import pytest
import worlds

import slamcli
from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import Frame
from slamcli.simulation import floors, photograph
from slamcli.simulation.config import FloorOptions


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
