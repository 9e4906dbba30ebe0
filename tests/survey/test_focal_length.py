"""The focal length of photos from all sides that hardly overlap, from matches alone."""

from __future__ import annotations

import math
from importlib import import_module
from itertools import combinations

import numpy as np
import pytest

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import apply_homography, invert
from slamcli.survey.lens import Lens, LensPrior
from slamcli.survey.pairs import Pair
from slamcli.survey.projection import LOG_SCALE, PITCH, STATES, YAW, project

SIZE, FOCAL, NOISE_PIXELS, MATCHES = np.array([800, 600]), 640.0, 0.4, 20


def photo_states(seed: int) -> Float64Array:
    generator = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(600.0, 2400.0, 4), np.linspace(-1500.0, -500.0, 3))
    states = np.zeros((x.size, STATES))
    states[:, :2] = np.column_stack([x.ravel(), y.ravel()])
    states[:, :2] += generator.normal(0.0, 60.0, (x.size, 2))
    states[:, YAW] = generator.normal(0.0, 0.15, x.size)
    states[:, LOG_SCALE] = generator.normal(0.0, 0.15, x.size)
    states[:, PITCH:] = generator.uniform(-0.4, 0.4, (x.size, 2))
    return states


def pairs_of(states: Float64Array, seed: int) -> list[Pair]:
    """Return pairs with a few matches each of the photos that share points of the board."""
    generator = np.random.default_rng([seed, 1])
    board = generator.uniform((0.0, -2000.0), (3000.0, 0.0), (2500, 2))
    image_from_map = project(states, FOCAL).image_from_map
    seen = [apply_homography(one, board) for one in image_from_map]
    found = []
    for a, b in combinations(range(len(states)), 2):
        both = np.all((np.abs(seen[a]) < SIZE / 2) & (np.abs(seen[b]) < SIZE / 2), axis=1)
        if both.sum() > 2 * MATCHES:
            some = np.flatnonzero(both)[:MATCHES]
            noise = generator.normal(0.0, NOISE_PIXELS, (2, MATCHES, 2))
            pixels = seen[a][some] + noise[0], seen[b][some] + noise[1]
            a_from_b = image_from_map[a] @ invert(image_from_map[b])
            found.append(Pair(a, b, a_from_b, *pixels, MATCHES, 0.9))
    return found


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_how_the_camera_moves_is_learned_with_the_focal_length(seed: int) -> None:
    states = photo_states(seed)
    guess = 1.5 * FOCAL
    lens = Lens(guess, 0.0, 500.0, LensPrior(math.log(guess), 0.5))
    solve = import_module("slamcli.survey.survey")._solve
    maps, contradicted = solve(pairs_of(states, seed), len(states), lens, level=False)
    assert not contradicted
    assert len(maps) == 1
    assert maps[0].bundle.lens.focal_pixels == pytest.approx(FOCAL, rel=0.04)
