"""Every acceptance gate on either side of its threshold, from records made by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made_records import alignment_of, fit_of, pair_of

from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.registration import acceptance, hypotheses
from slamcli.registration.hypothesis import MotionHypothesis

OPTIONS = MapperOptions()
NAN = math.nan


def plausible(
    fit: MotionHypothesis,
    limit_metres: float = math.inf,
    *,
    beside_features: bool = False,
    backed: bool = False,
) -> str:
    return acceptance.check_plausible(
        fit, limit_metres, OPTIONS, beside_features=beside_features, backed=backed
    )


@pytest.mark.parametrize(("inliers", "enough"), [(119, False), (120, True), (121, True)])
def test_features_are_enough_from_the_convincing_number_on(inliers: int, enough: bool) -> None:
    assert acceptance.enough_inliers(alignment_of(inliers), OPTIONS) is enough
    assert acceptance.convincing(alignment_of(inliers), fit_of(), OPTIONS) is enough


@pytest.mark.parametrize(
    ("correlation", "confirmed", "convincing"),
    [
        (0.5, 0.0, True),
        (0.499, 0.0, False),
        (0.499, 0.35, True),
        (0.499, 0.349, False),
        (NAN, NAN, False),
        (NAN, 0.35, True),
        (0.5, NAN, True),
    ],
)
def test_enough_features_convince_where_the_pixels_or_their_patches_agree(
    correlation: float, confirmed: float, convincing: bool
) -> None:
    fit = fit_of(correlation=correlation, confirmed=confirmed)
    assert acceptance.convincing(alignment_of(120), fit, OPTIONS) is convincing


@pytest.mark.parametrize(("inliers", "backed"), [(35, False), (36, True)])
def test_three_times_the_required_inliers_back_the_pixels(inliers: int, backed: bool) -> None:
    assert acceptance.backed_by_features(alignment_of(inliers), OPTIONS) is backed


def test_why_features_alone_are_not_accepted_names_what_is_missing() -> None:
    few = acceptance.too_few_inliers(alignment_of(119), OPTIONS)
    assert few.startswith("119 inliers without the pixels' confirmation are too few (of 120)")
    unconfirmed = acceptance.too_few_inliers(alignment_of(120), OPTIONS)
    assert unconfirmed == "the pixels do not confirm the 120 inliers"


def test_the_robot_moves_no_farther_than_its_steps_between_two_frames() -> None:
    options = replace(OPTIONS, max_step_metres=0.1)
    assert acceptance.max_displacement_metres(3, 9, OPTIONS) == math.inf
    assert acceptance.max_displacement_metres(3, 5, options) == pytest.approx(0.2)
    assert acceptance.max_displacement_metres(5, 3, options) == pytest.approx(0.2)
    assert acceptance.max_displacement_metres(5, 5, options) == pytest.approx(0.1)


def test_a_fit_that_passes_every_gate_is_plausible() -> None:
    assert plausible(fit_of()) == ""


@pytest.mark.parametrize(("x", "rejected"), [(0.2, False), (-0.2, False), (0.201, True)])
def test_a_fit_that_moves_the_robot_too_far_is_rejected(x: float, rejected: bool) -> None:
    reason = plausible(fit_of(Pose2(x)), 0.2)
    assert reason.startswith("the fit moves the robot") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(
    ("degrees", "rejected"), [(74.9, False), (75.1, True), (-74.9, False), (-75.1, True)]
)
def test_a_fit_that_turns_the_robot_too_far_is_rejected(degrees: float, rejected: bool) -> None:
    reason = plausible(fit_of(Pose2(0.0, 0.0, math.radians(degrees))))
    assert reason.startswith("the fit turns the robot") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(("overlap", "rejected"), [(0.1, False), (0.099, True)])
def test_a_fit_that_leaves_too_little_overlap_is_rejected(overlap: float, rejected: bool) -> None:
    reason = plausible(fit_of(overlap=overlap))
    assert reason.startswith("the fit leaves an overlap") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(
    ("confirmed", "backed", "rejected"),
    [
        (0.35, False, False),
        (0.349, False, True),
        (0.1, True, False),
        (0.099, True, True),
        (NAN, False, False),
    ],
)
def test_a_fit_that_too_few_patches_agree_with_is_rejected(
    confirmed: float, backed: bool, rejected: bool
) -> None:
    reason = plausible(fit_of(confirmed=confirmed), backed=backed)
    assert reason.startswith("the views differ") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(
    ("correlation", "confirmed", "beside_features", "backed", "rejected"),
    [
        (0.3, NAN, False, False, False),
        (0.299, NAN, False, False, True),
        (NAN, NAN, False, False, True),
        # Enough patches that agree stand in for the correlation.
        (0.299, 0.5, False, False, False),
        (0.299, 0.499, False, False, True),
        (NAN, 0.5, False, False, False),
        # Beside features as many as must agree anyhow; backed by features, a tenth.
        (0.299, 0.35, True, False, False),
        (0.299, 0.1, False, True, False),
        (0.299, NAN, False, True, True),
    ],
)
def test_a_fit_that_the_pixels_disagree_with_is_rejected(
    correlation: float, confirmed: float, beside_features: bool, backed: bool, rejected: bool
) -> None:
    fit = fit_of(correlation=correlation, confirmed=confirmed)
    reason = plausible(fit, beside_features=beside_features, backed=backed)
    assert reason.startswith("the pixels disagree") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(
    ("correlation", "confirmed", "rejected"),
    [(0.45, 0.4, False), (0.449, 0.4, True), (0.449, 0.5, False), (0.449, 0.499, True)],
)
def test_pixels_alone_must_be_similar_or_have_enough_agreeing_patches(
    correlation: float, confirmed: float, rejected: bool
) -> None:
    fit = fit_of(correlation=correlation, confirmed=confirmed)
    reason = acceptance.check_similarity(pair_of(), fit, OPTIONS)
    assert reason.startswith("the views are too dissimilar") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(
    ("correlation", "coarse", "rejected"),
    [
        # The coarse correlation limits the fine one...
        (0.8, 0.45, False),
        (0.8, 0.449, True),
        # ... by 0.4 at most, and does not raise it.
        (0.86, 0.0, False),
        (0.84, 0.0, True),
        (0.44, 0.9, True),
    ],
)
def test_where_too_few_patches_are_informative_the_coarse_correlation_counts(
    monkeypatch: pytest.MonkeyPatch, correlation: float, coarse: float, rejected: bool
) -> None:
    monkeypatch.setattr(hypotheses, "coarse_similarity", lambda pair, fit: coarse)
    fit = fit_of(correlation=correlation, confirmed=NAN)
    assert bool(acceptance.check_similarity(pair_of(), fit, OPTIONS)) is rejected


@pytest.mark.parametrize(("overlap", "rejected"), [(0.2, False), (0.199, True)])
def test_what_a_search_found_must_share_a_fifth_of_the_floor(
    overlap: float, rejected: bool
) -> None:
    reason = acceptance.check_similarity(pair_of(), fit_of(overlap=overlap), OPTIONS)
    assert reason.startswith("the views share") is rejected
    assert bool(reason) is rejected


@pytest.mark.parametrize(
    ("inliers", "contradicts", "rejected"), [(120, True, True), (119, True, False), (120, False, 0)]
)
def test_a_motion_that_contradicts_enough_features_is_rejected(
    inliers: int, contradicts: bool, rejected: bool
) -> None:
    reason = acceptance.check_agrees_with_features(
        alignment_of(inliers), OPTIONS, contradicts=contradicts
    )
    assert bool(reason) == rejected


@pytest.mark.parametrize(("rival", "rejected"), [(0.75, False), (0.751, True), (0.0, False)])
def test_a_rival_with_nearly_as_much_evidence_makes_a_motion_ambiguous(
    rival: float, rejected: bool
) -> None:
    reason = acceptance.check_unique(rival, OPTIONS)
    assert reason.startswith("ambiguous: another motion") is rejected
    assert bool(reason) is rejected


def test_a_rival_that_remains_makes_a_motion_ambiguous() -> None:
    reason = acceptance.check_rivals(fit_of(Pose2(0.05)), fit_of(Pose2(0.35)))
    assert reason == "ambiguous: the floor repeats, and a motion 0.3 farther on fits as well"
    assert acceptance.check_rivals(fit_of(), None) == ""


@pytest.mark.parametrize(("sigma", "rejected"), [(0.0139, False), (0.0141, True)])
def test_a_motion_is_open_where_its_sigma_is_too_large_a_share_of_the_range(
    sigma: float, rejected: bool
) -> None:
    reason = acceptance.check_observable(fit_of(sigmas=(0.001, sigma, 0.001)), 2.0, OPTIONS)
    assert bool(reason) is rejected
    if rejected:
        assert reason.startswith("the motion is open along 90 degrees (one sigma 0.014)")


def test_the_open_direction_is_the_widest_of_the_covariance() -> None:
    fit, along = fit_of(), np.array([math.cos(0.5), math.sin(0.5)])
    covariance = fit.predicted_covariance.copy()
    covariance[:2, :2] += 0.01 * np.outer(along, along)
    open_fit = replace(fit, predicted_covariance=covariance)
    reason = acceptance.check_observable(open_fit, 2.0, OPTIONS)
    assert reason.startswith(f"the motion is open along {math.degrees(0.5):.0f} degrees")


def test_a_motion_is_open_too_where_the_residuals_alone_show_it() -> None:
    fit = fit_of()
    shown = replace(fit, covariance=fit.covariance + np.diag([0.0, 0.01, 0.0]))
    assert acceptance.check_observable(fit, 2.0, OPTIONS) == ""
    reason = acceptance.check_observable(shown, 2.0, OPTIONS)
    assert reason.startswith("the motion is open along 90 degrees")


@pytest.mark.parametrize(("sigma", "rejected"), [(0.0139, False), (0.0141, True)])
def test_a_turn_is_open_where_its_sigma_is_too_large(sigma: float, rejected: bool) -> None:
    reason = acceptance.check_observable(fit_of(sigmas=(0.001, 0.001, sigma)), 2.0, OPTIONS)
    assert reason.startswith("the turn is open") is rejected
    assert bool(reason) is rejected
