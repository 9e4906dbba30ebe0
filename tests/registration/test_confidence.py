"""The confidence in a motion: each piece of evidence, and what it does to the probability."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hand_made_records import alignment_of, fit_of, pair_of

from slamcli.core.arrays import Float64Array
from slamcli.core.geometry import Pose2
from slamcli.core.records import FeatureAlignment
from slamcli.registration import confidence
from slamcli.registration.hypothesis import MotionHypothesis, same_motion

PAIR = pair_of()
HERE = Pose2(0.05)
FEW = alignment_of(0)


def all_evidence_of(
    fit: MotionHypothesis, alignment: FeatureAlignment, decision: confidence.Decision
) -> Float64Array:
    agrees = alignment.pose is not None and same_motion(alignment.pose, fit.pose, PAIR)
    return confidence.evidence(fit, alignment, 2.0, decision, agrees=agrees)


def evidence_of(
    fit: MotionHypothesis,
    alignment: FeatureAlignment = FEW,
    rival: float = math.nan,
    searched_metres: float = 0.0,
) -> dict[str, float]:
    found = all_evidence_of(fit, alignment, confidence.Decision(rival, searched_metres))
    return dict(zip(confidence.EVIDENCE, found[:-1].tolist(), strict=True))


def test_every_piece_of_evidence_has_a_weight_of_the_right_sign() -> None:
    weights = dict(zip(confidence.EVIDENCE, confidence.WEIGHTS, strict=True))
    against = {
        "constant",
        "inliers that disagree",
        "rival",
        "searched far and wide",
        "not accepted",
    }
    assert {name for name, weight in weights.items() if weight < 0.0} == against


def test_the_score_is_the_logistic_of_the_weighted_evidence() -> None:
    nothing = np.zeros(len(confidence.EVIDENCE) + 1)
    assert confidence.score(nothing) == 0.5
    nothing[1] = 1.0
    expected = 1.0 / (1.0 + math.exp(-confidence.WEIGHTS[1]))
    assert confidence.score(nothing) == pytest.approx(expected)


def test_a_rival_that_is_left_takes_half_of_the_probability() -> None:
    fit, alignment = fit_of(HERE, correlation=0.99, confirmed=1.0), alignment_of(1000, HERE)
    scores = [
        confidence.score(all_evidence_of(fit, alignment, confidence.Decision(0.1, 0.0, left)))
        for left in (False, True)
    ]
    assert scores[0] > 0.99
    assert scores[1] == pytest.approx(scores[0] / 2.0)


def test_a_motion_that_was_refused_scores_less() -> None:
    fit, alignment = fit_of(HERE, correlation=0.6, confirmed=0.5), alignment_of(30, HERE)
    scores = [
        confidence.score(
            all_evidence_of(fit, alignment, confidence.Decision(0.5, 0.3, False, refused))
        )
        for refused in (False, True)
    ]
    assert scores[1] < scores[0]


@pytest.mark.parametrize(
    ("correlation", "similarity"),
    [
        (math.nan, 0.0),
        (-0.5, 0.0),
        (0.0, 0.0),
        (math.sqrt(0.9), 1.0 / 3.0),
        (math.sqrt(0.999), 1.0),
        (1.0, 1.0),
    ],
)
def test_a_correlation_counts_by_the_logarithm_of_what_it_leaves(
    correlation: float, similarity: float
) -> None:
    found = evidence_of(fit_of(HERE, correlation=correlation))
    assert found["correlation of the overlap"] == pytest.approx(similarity)


def test_too_few_informative_patches_are_evidence_of_their_own() -> None:
    found = evidence_of(fit_of(HERE, confirmed=0.7))
    assert (found["agreeing patches"], found["too few informative patches"]) == (0.7, 0.0)
    found = evidence_of(fit_of(HERE, confirmed=math.nan))
    assert (found["agreeing patches"], found["too few informative patches"]) == (0.0, 1.0)


def test_inliers_count_for_a_motion_that_is_theirs_and_against_another() -> None:
    for x, agrees in ((0.169, True), (0.171, False)):
        found = evidence_of(fit_of(HERE), alignment_of(1000, Pose2(x)))
        assert found["inliers that agree"] == float(agrees)
        assert found["inliers that disagree"] == float(not agrees)
    found = evidence_of(fit_of(HERE), alignment_of(1000))
    assert found["inliers that disagree"] == 1.0


def test_a_rival_and_a_wide_search_count_only_where_the_pixels_decided() -> None:
    found = evidence_of(fit_of(HERE), rival=0.6, searched_metres=0.5)
    assert (found["rival"], found["searched far and wide"]) == (0.6, 0.25)
    assert (
        evidence_of(fit_of(HERE), rival=0.6, searched_metres=math.inf)["searched far and wide"]
        == 1.0
    )
    found = evidence_of(fit_of(HERE), searched_metres=0.5)
    assert (found["rival"], found["searched far and wide"]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("sigma", "sharpness"), [(2e-4, 1.0), (2e-5, 1.0), (2e-2, 0.5), (2.0, 0.0), (9.0, 0.0)]
)
def test_sharpness_is_the_logarithm_of_the_widest_sigma(sigma: float, sharpness: float) -> None:
    found = evidence_of(fit_of(HERE, sigmas=(1e-9, sigma, 1.0)))
    assert found["sharpness"] == pytest.approx(sharpness)


def test_inliers_count_as_a_share_of_all_matches_too() -> None:
    share = "share of the matches that agree"
    alignment = alignment_of(1000, HERE)
    expected = alignment.inlier_count / len(alignment.matches)
    assert evidence_of(fit_of(HERE), alignment)[share] == pytest.approx(expected)
    assert evidence_of(fit_of(HERE), alignment_of(1000))[share] == 0.0
