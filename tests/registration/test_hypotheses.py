"""Comparison of motion hypotheses, from records made by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made_records import fit_of, pair_of

from slamcli.core.arrays import Float64Array
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import PyramidLevel
from slamcli.registration import hypotheses
from slamcli.registration.hypothesis import MotionHypothesis, same_motion
from slamcli.simulation import photograph
from slamcli.simulation.config import CameraOptions
from slamcli.stages import dense

CALIBRATION = photograph.make_camera(CameraOptions(size=(400, 300)))
PAIR = pair_of()


@pytest.mark.parametrize(
    ("other", "same"),
    [
        (Pose2(0.1699), True),
        (Pose2(0.1701), False),
        (Pose2(0.05, 0.0, 0.0499), True),
        (Pose2(0.05, 0.0, 0.0501), False),
        (Pose2(0.05, 0.0, -0.0501), False),
        (Pose2(0.05, 0.0, math.tau - 0.0499), True),
    ],
)
def test_motions_are_the_same_within_three_coarse_pixels_and_a_twentieth_of_a_radian(
    other: Pose2, same: bool
) -> None:
    assert same_motion(Pose2(0.05), other, PAIR) is same


@pytest.mark.parametrize(
    ("pro", "contra", "preferred"),
    [
        (0.15, 0.0249, True),
        (0.149, 0.0, False),
        (0.6, 0.0999, True),
        (0.6, 0.1001, False),
        (math.nan, math.nan, False),
    ],
)
def test_patches_prefer_a_motion_when_many_vote_for_it_and_few_for_its_rival(
    monkeypatch: pytest.MonkeyPatch, pro: float, contra: float, preferred: bool
) -> None:
    monkeypatch.setattr(dense, "patch_votes", lambda a, b, motion, rival: (pro, contra))
    assert hypotheses.preferred_by_patches(PAIR, fit_of(), fit_of()) is preferred


@pytest.mark.parametrize(
    ("coarse", "similarity"), [(0.9, 0.7), (0.6, 0.5), (0.71, 0.51), (0.69, 0.5)]
)
def test_the_coarse_similarity_counts_less_by_a_fifth(
    monkeypatch: pytest.MonkeyPatch, coarse: float, similarity: float
) -> None:
    found = dense.Candidate(Pose2(), coarse, 1.0, 1.0)
    monkeypatch.setattr(dense, "evidence", lambda a, b, pose, matrix: found)
    fit = fit_of(normalised_correlation=0.5)
    assert hypotheses.coarse_similarity(PAIR, fit) == pytest.approx(similarity)


@pytest.mark.parametrize(
    ("apart", "kept"),
    [
        (Pose2(0.0, 0.9), False),
        (Pose2(0.0399, 0.9), False),
        (Pose2(0.0401, 0.0), True),
        (Pose2(-0.0401, 0.0), True),
        (Pose2(0.0, 0.0, 0.0799), False),
        (Pose2(0.0, 0.0, 0.0801), True),
        (Pose2(0.0, 0.0, -0.0801), True),
    ],
)
def test_only_what_differs_across_the_open_direction_is_another_motion(
    apart: Pose2, kept: bool
) -> None:
    best = fit_of(Pose2(0.05), sigmas=(0.01, 0.5, 0.02))
    other = fit_of(best.pose @ apart)
    assert (hypotheses.outside_open_direction([other], best) == [other]) is kept


def test_of_equal_motions_with_about_the_same_evidence_the_most_certain_is_kept() -> None:
    vague = fit_of(Pose2(0.05), evidence=100.0, sigmas=(0.01, 0.01, 0.01))
    certain = fit_of(Pose2(0.06), evidence=95.1)
    weaker = replace(certain, evidence=95.0)
    elsewhere = fit_of(Pose2(0.5), evidence=97.0)
    assert hypotheses.without_duplicates([certain, vague], PAIR) == [certain]
    assert hypotheses.without_duplicates([weaker, vague], PAIR) == [vague]
    vaguer = replace(certain, predicted_covariance=2.0 * vague.predicted_covariance)
    assert hypotheses.without_duplicates([vaguer, vague], PAIR) == [vague]
    assert hypotheses.without_duplicates([elsewhere, vague], PAIR) == [vague, elsewhere]


def test_peaks_of_less_than_two_fifths_of_the_best_ones_evidence_are_not_followed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    peaks = {0.0: 100.0, 0.5: 40.0, 1.0: 39.9, 1.5: 90.0, 1.55: 89.0, 2.0: 80.0, 2.5: 45.0}
    # On the level of the search itself, refined.
    refined = {**peaks, 1.0: 85.0, 2.5: 39.9}
    found = dense.Search(
        tuple(
            dense.Candidate(Pose2(x), 0.5, 0.5, peaks[x])
            for x in sorted(peaks, key=lambda x: -peaks[x])
        ),
        np.zeros((1, 1), np.float32),
        0.04,
    )
    followed: list[float] = []

    def refine_hypothesis(*given: object) -> MotionHypothesis | None:
        start = given[1]
        assert isinstance(start, Pose2)
        assert given[2] is None
        followed.append(start.x)
        return None if start.x == 1.5 else fit_of(start)

    def evidence(
        a: PyramidLevel, b: PyramidLevel, pose: Pose2, matrix: Float64Array
    ) -> dense.Candidate:
        return dense.Candidate(pose, 0.5, 0.5, refined[pose.x])

    monkeypatch.setattr(dense, "search", lambda a, b, window, min_overlap, count: found)
    monkeypatch.setattr(dense, "refine", lambda *given: None)
    monkeypatch.setattr(dense, "evidence", evidence)
    monkeypatch.setattr(hypotheses, "refine_hypothesis", refine_hypothesis)
    for count, starts in ((3, [0.0, 1.5, 2.0]), (6, [0.0, 1.5, 2.0, 0.5])):
        followed.clear()
        options = MapperOptions(max_hypotheses=count)
        search, fits = hypotheses.search(PAIR, dense.SearchWindow(), CALIBRATION, options)
        assert search is found
        assert followed == starts
        assert [fit.pose.x for fit in fits] == [x for x in starts if x != 1.5]
