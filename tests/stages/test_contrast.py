"""The detail that views are compared by: contrast to what is around, which blur moves little."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from slamcli.core.arrays import UInt8Array
from slamcli.core.geometry import Pose2
from slamcli.core.light import SATURATION, codes_of_light, light_of_codes
from slamcli.core.records import View
from slamcli.stages import dense
from tests.floor_pictures import asphalt, square_grid, top_down

SIDE = 400


def white_stub_on_black(blur_pixels: float) -> UInt8Array:
    """Return a white stub on black, one side of it beyond the picture, blurred in light."""
    light = np.full((SIDE, SIDE), light_of_codes("srgb")[12])
    light[:90, 150:] = light_of_codes("srgb")[230]
    light = cv2.GaussianBlur(light, (0, 0), blur_pixels)
    return np.rint(codes_of_light(light, "srgb")).astype(np.uint8)


def view_of(picture: UInt8Array) -> View:
    return View(square_grid(SIDE), picture, np.full((SIDE, SIDE), 255, np.uint8))


def test_an_edge_of_paint_hardly_moves_when_it_is_seen_less_sharply() -> None:
    """By gray levels it would move by 0.8 pixels, by their logarithm by 1.4."""
    sharp, blurred = (
        dense.make_levels(view_of(white_stub_on_black(blur)))[1:] for blur in (1.5, 2.2)
    )
    found = dense.refine(sharp, blurred, Pose2(), top_down(), 0.0)
    assert found is not None
    assert found.a_from_b.translation_length < 0.7
    assert abs(math.degrees(found.a_from_b.theta)) < 0.02


def test_a_lamp_that_dims_slowly_across_the_view_leaves_the_detail_as_it_is() -> None:
    floor = asphalt(SIDE)
    light = light_of_codes("srgb")[floor]
    lamp = np.linspace(0.4, 1.0, SIDE)[None, :]
    dimmed = np.rint(codes_of_light(light * lamp, "srgb")).astype(np.uint8)
    first, second = (dense.make_levels(view_of(picture))[0] for picture in (floor, dimmed))
    inside = first.inside == 255
    assert np.corrcoef(first.detail[inside], second.detail[inside])[0, 1] > 0.99
    assert second.detail[inside].std() == pytest.approx(first.detail[inside].std(), rel=0.1)
    assert light.max() <= SATURATION
