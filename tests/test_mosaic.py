"""The canvas, with patches whose places are known."""

from __future__ import annotations

import numpy as np

from slamcli.core.geometry import Grid
from slamcli.core.records import Tile
from slamcli.stages.mosaic import TILE_PIXELS, Canvas, picture_weight

SCALE = 0.01


def patch(column: int, row: int, width: int, height: int, gray: int, weight: float) -> Tile:
    """A flat patch whose upper left pixel is (column, row) of the endless raster."""
    grid = Grid(column * SCALE, -row * SCALE, SCALE, width, height)
    return Tile(
        grid,
        np.full((height, width, 3), gray, np.uint8),
        np.full((height, width), weight, np.float32),
    )


def test_the_pixel_seen_best_wins_whatever_the_order() -> None:
    near, far = patch(0, 0, 20, 10, 200, 5.0), patch(10, 0, 20, 10, 50, 1.0)
    pictures = []
    for order in ((near, far), (far, near)):
        canvas = Canvas(SCALE)
        for one in order:
            canvas.paint(one)
        grid = canvas.extent()
        assert grid is not None
        assert (grid.width, grid.height) == (30, 10)
        pictures.append(canvas.flatten(grid)[0])
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert pictures[0][5, 19, 0] == 200
    assert pictures[0][5, 20, 0] == 50


def test_a_patch_over_many_tiles_comes_back_whole() -> None:
    canvas = Canvas(SCALE)
    size = TILE_PIXELS + 40
    one = patch(-20, -30, size, size, 7, 1.0)
    one.image[:] = np.random.default_rng(0).integers(0, 255, one.image.shape, dtype=np.uint8)
    canvas.paint(one)
    assert len(list(canvas.tiles())) == 9
    grid = canvas.extent()
    assert grid is not None
    np.testing.assert_allclose(
        (grid.x_min, grid.y_max, grid.width, grid.height), (-0.2, 0.3, size, size)
    )
    image, mask = canvas.flatten(grid)
    np.testing.assert_array_equal(image, one.image)
    assert mask.all()


def test_the_area_is_what_was_seen() -> None:
    canvas = Canvas(SCALE)
    assert canvas.extent() is None
    canvas.paint(patch(0, 0, 10, 10, 1, 1.0))
    canvas.paint(patch(5, 0, 10, 10, 1, 1.0))
    np.testing.assert_allclose(canvas.seen_area(), 150 * SCALE**2)


def test_weight_grows_with_sharpness_and_fades_at_the_border() -> None:
    sharpness = np.full((100, 100), 500.0, np.float32)
    sharpness[50:] = 250.0
    sharpness[:, 80:] = 0.0
    weight = picture_weight(sharpness)
    assert weight[40, 40] == 2 * weight[60, 40] > 0
    assert weight[40, 79] < weight[40, 70] < weight[40, 40]
    assert not weight[:, 80:].any()
