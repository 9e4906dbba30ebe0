"""Which pair is false, where the pairs of a survey's map contradict one another."""

from __future__ import annotations

import numpy as np

from slamcli.survey.false_pairs import least_correlated
from slamcli.survey.pairs import Pair


def pair(a: int, b: int, correlation: float) -> Pair:
    return Pair(a, b, np.eye(3), np.zeros((0, 2)), np.zeros((0, 2)), 50, correlation)


def test_of_a_contradictory_cycle_the_pair_is_false_whose_pixels_agree_least() -> None:
    copied = pair(1, 5, 0.9)
    kept = [pair(0, 1, 0.98), copied, pair(5, 6, 0.97)]
    assert least_correlated(kept, [], []) is None
    assert least_correlated(kept, [(0, 6)], []) is copied
    assert least_correlated(kept, [], [pair(0, 5, 0.96)]) is copied
    assert least_correlated(kept, [], [pair(0, 5, 0.8), pair(2, 5, 0.99)]) is None
