"""Occupancy of cells: floor with texture, paint, and a thing that hides the floor behind it."""

from __future__ import annotations

import numpy as np
import pytest

from slamcli.core.arrays import BoolArray, Float64Array, UInt8Array
from slamcli.stages.mosaic import occupancy
from slamcli.stages.mosaic.occupancy import Occupancy, classify, floor_evidence

SIDE, CELL_METRES, HEIGHT_METRES = 64, 0.008, 0.3
BOX = (slice(30, 38), slice(28, 36))
PAINT = (slice(8, 16), slice(40, 50))
FAR_APART = np.array([(0.0, 0.0), (0.1, 0.0), (0.2, 0.0), (0.3, 0.0)])


def views(count: int, *, box: bool = True, seed: int = 0) -> UInt8Array:
    """Return views of textured floor with a painted patch, and a thing whose top leans away."""
    rng = np.random.default_rng(seed)
    floor = rng.normal(120, 14, (SIDE, SIDE, 1)).repeat(3, axis=2)
    floor[PAINT] = 210
    found = []
    for number in range(count):
        seen = floor + rng.normal(0, 1.0, floor.shape)
        if box:
            seen[BOX] = (60, 90, 160)
            # Behind the box, seen from ever farther to the side.
            for row in range(12):
                shift = round(row * (number - 1.5) * 0.8)
                seen[30 - row - 1, 28 + shift : 36 + shift] = (60, 90, 160)
        found.append(np.clip(seen, 0, 255).astype(np.uint8))
    return np.stack(found)


def found_in(
    cells: UInt8Array, positions: Float64Array = FAR_APART, seen_rows: int = SIDE
) -> Occupancy:
    weights = np.ones(cells.shape[:3], np.float32)
    weights[:, seen_rows:] = 0
    evidence = floor_evidence(cells, weights, positions[: len(cells)])
    return classify(
        evidence,
        cells[0],
        np.zeros((SIDE, SIDE), np.bool_),
        occupancy.plain_below(evidence.texture_gray),
        occupancy.min_baseline(CELL_METRES, HEIGHT_METRES, metric=True),
    )


def outline(part: tuple[slice, slice]) -> BoolArray:
    inside = np.zeros((SIDE, SIDE), np.bool_)
    inside[part] = True
    inside[part[0].start + 1 : part[0].stop - 1, part[1].start + 1 : part[1].stop - 1] = False
    return inside


def test_a_plain_thing_is_occupied_and_a_painted_patch_is_free() -> None:
    found = found_in(views(4))
    assert found.occupied[outline(BOX)].all()
    assert not found.free[BOX].any()
    assert not found.occupied[PAINT].any()
    inner = (slice(10, 14), slice(42, 48))
    assert found.free[inner].all()
    # Floor in front of the thing, which all see.
    assert found.free[44:60, 5:60].mean() > 0.98


def test_an_empty_floor_has_no_speck() -> None:
    for seed in range(5):
        found = found_in(views(4, box=False, seed=seed))
        assert not found.occupied.any()
        assert found.free[2:-2, 2:-2].mean() > 0.97


@pytest.mark.parametrize("count", [1, 4])
def test_nothing_is_free_that_is_seen_from_one_place(count: int) -> None:
    """A thing there would look the same in all of these views: paint may be one."""
    found = found_in(views(count, box=False), np.zeros((count, 2)))
    assert not found.free.any()
    assert found.occupied[PAINT].all()
    found.occupied[PAINT[0].start - 3 : PAINT[0].stop + 3, PAINT[1].start - 3 :] = False
    assert not found.occupied.any()


def test_a_part_that_goes_on_beyond_what_was_seen_may_stand() -> None:
    """Neither its top nor what it hides is in any view: it is not taken for paint."""
    cells = views(4, box=False)
    cells[:, 56:, 28:36] = (60, 90, 160)
    whole, cut = found_in(cells), found_in(cells, seen_rows=62)
    assert not whole.occupied.any()
    assert cut.occupied[57:61, 28:36].all()
    assert not cut.free[56:, 28:36].any()


def test_a_lower_thing_is_betrayed_by_views_farther_apart() -> None:
    low, high = (occupancy.min_baseline(0.008, height, metric=True) for height in (0.3, 1.5))
    assert low == pytest.approx(2 * 0.008 * 0.26 / 0.04)
    assert high > low
    # Without metres it is a share of the camera's height, whatever that is.
    assert occupancy.min_baseline(1.0, float("inf"), metric=False) == pytest.approx(2 * 0.87 / 0.13)


def test_the_way_that_was_driven_is_floor_however_plain() -> None:
    """Beside a box on a floor without texture views differ, too."""
    cells = views(4)
    cells[:, 40:] = 120
    weights = np.ones(cells.shape[:3], np.float32)
    evidence = floor_evidence(cells, weights, FAR_APART)
    driven = np.zeros((SIDE, SIDE), np.bool_)
    driven[50, 30] = True
    found = classify(evidence, cells[0], driven, occupancy.plain_below(evidence.texture_gray), 0.1)
    assert found.free[44:60, 5:60].all()
    assert found.occupied[outline(BOX)].mean() > 0.9


def test_outlines_go_around_the_cells() -> None:
    occupied = np.zeros((10, 10), np.bool_)
    occupied[2:4, 5:8] = True
    (corners,) = occupancy.outlines(occupied)
    assert corners.min(axis=0).tolist() == [5, 2]
    assert corners.max(axis=0).tolist() == [8, 4]
    assert abs(occupancy.signed_area(corners.astype(np.float64))) == pytest.approx(6.0)


def test_a_thing_on_the_way_is_one_all_the_same() -> None:
    """It was put there later, or the way leads beneath the camera's mast over it."""
    cells = views(4)
    evidence = floor_evidence(cells, np.ones(cells.shape[:3], np.float32), FAR_APART)
    driven = np.zeros((SIDE, SIDE), np.bool_)
    driven[BOX[0].start, BOX[1]] = True
    plain = occupancy.plain_below(evidence.texture_gray)
    found = classify(evidence, cells[0], driven, plain, 0.1)
    assert found.occupied[outline(BOX)].all()
