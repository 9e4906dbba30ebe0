"""The three steps of the photometric refinement, with scripted fits in place of pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hand_made_records import fit_of, pair_of

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import PyramidLevel
from slamcli.registration import criteria, refinement
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.simulation import photograph
from slamcli.simulation.config import CameraOptions
from slamcli.stages import dense

CALIBRATION = photograph.make_camera(CameraOptions(size=(400, 300)))
OPTIONS = MapperOptions()
SIGMA = math.radians(OPTIONS.tilt_sigma_degrees)
PAIR = pair_of()
MASKED = (PAIR.a[0],)
START = Pose2(0.05)
COVARIANCE = np.eye(3) * 1e-6
ROCKED = np.diag([1.01, 1.0, 1.0])


@dataclass
class Script:
    """The fits that refinements come out with, one after the other, and what they were given."""

    start: MotionHypothesis
    fits: list[MotionHypothesis | None]
    calls: list[tuple[float, Pose2, int, bool, bool]] = field(default_factory=list)
    masks: int = 0

    def refine(
        self,
        levels_a: Sequence[PyramidLevel],
        levels_b: Sequence[PyramidLevel],
        pose: Pose2,
        calibration: Calibration,
        tilt: float,
        assumptions: dense.RefinementAssumptions,
    ) -> dense.PhotometricFit | None:
        self.calls.append(
            (tilt, pose, len(levels_a), assumptions.from_search, assumptions.rocking is not None)
        )
        fit = self.fits[len(self.calls) - 1]
        if fit is None:
            return None
        return dense.PhotometricFit(
            fit.pose,
            fit.predicted_covariance,
            fit.covariance,
            fit.view_a_from_view_b,
            np.zeros(0),
            np.zeros(0),
            fit.rocking_suspected,
        )

    def score_refined(self, pair: PyramidPair, refined: dense.PhotometricFit) -> MotionHypothesis:
        fit = self.fits[len(self.calls) - 1]
        assert fit is not None
        assert refined.a_from_b == fit.pose
        return fit

    def photometric_score(
        self, pair: PyramidPair, pose: Pose2, covariance: Float64Array, matrix: Float64Array
    ) -> MotionHypothesis:
        return self.start

    def keep_agreeing_points(
        self, levels: Sequence[PyramidLevel], level: PyramidLevel, matrix: Float64Array
    ) -> tuple[PyramidLevel, ...]:
        self.masks += 1
        return MASKED

    @property
    def tilts(self) -> list[float]:
        return [round(tilt / SIGMA, 6) for tilt, *_ in self.calls]


Scripted = Callable[..., Script]


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    def follow(start: MotionHypothesis, *fits: MotionHypothesis | None) -> Script:
        script = Script(start, list(fits))
        monkeypatch.setattr(dense, "refine", script.refine)
        monkeypatch.setattr(dense, "keep_agreeing_points", script.keep_agreeing_points)
        monkeypatch.setattr(refinement, "score_refined", script.score_refined)
        monkeypatch.setattr(refinement, "photometric_score", script.photometric_score)
        return script

    return follow


def refined(
    covariance: Float64Array | None = COVARIANCE,
    options: MapperOptions = OPTIONS,
    pair: PyramidPair = PAIR,
) -> MotionHypothesis | None:
    return refinement.refine_hypothesis(pair, START, covariance, CALIBRATION, options)


def unsteady(**numbers: Any) -> MotionHypothesis:
    """Return a fit that a steady camera does not explain."""
    return fit_of(START, normalised_correlation=0.8, correlation=0.8, evidence=50.0, **numbers)


def steady_fit() -> MotionHypothesis:
    return fit_of(START, normalised_correlation=0.97)


# (1) With a steady camera.


def test_a_steady_fit_that_explains_all_needs_no_other_step(scripted: Scripted) -> None:
    script = scripted(unsteady(), steady_fit())
    assert refined() is script.fits[0]
    assert script.calls == [(0.0, START, 2, False, False)]


@pytest.mark.parametrize(
    "steady",
    [
        fit_of(Pose2(0.071), normalised_correlation=0.97),
        fit_of(START, normalised_correlation=0.949),
        fit_of(START, normalised_correlation=0.97, rocking_suspected=True),
        fit_of(START, normalised_correlation=0.97, sigmas=(0.001, 0.05, 0.001)),
        fit_of(START, normalised_correlation=0.97, confirmed=0.49),
    ],
    ids=["diverged", "correlation", "rocking suspected", "open", "obstructed"],
)
def test_a_steady_fit_that_does_not_is_compared_with_its_start(
    scripted: Scripted, steady: MotionHypothesis
) -> None:
    start = replace(steady_fit(), evidence=1000.0)
    script = scripted(start, steady, None, None)
    assert refined() is start
    assert script.tilts == [0.0]


def test_without_refinement_the_start_is_scored_alone(scripted: Scripted) -> None:
    start = unsteady()
    script = scripted(start)
    assert refined(options=replace(OPTIONS, refine=False)) is start
    assert script.calls == []


def test_a_steady_fit_wins_by_evidence_alone(scripted: Scripted) -> None:
    start = replace(unsteady(), evidence=100.0)
    better = replace(unsteady(), evidence=100.1)
    scripted(start, better, None, None)
    assert refined() is better
    scripted(start, replace(better, evidence=100.0), None, None)
    assert refined() is start


@pytest.mark.parametrize(
    ("pulled", "kept"),
    [
        (fit_of(Pose2(0.08), normalised_correlation=0.8, correlation=0.8, evidence=900.0), False),
        (fit_of(Pose2(0.069), normalised_correlation=0.8, correlation=0.8, evidence=900.0), True),
        (
            fit_of(
                Pose2(0.08),
                normalised_correlation=0.8,
                correlation=0.8,
                evidence=900.0,
                sigmas=(0.006, 0.001, 0.001),
            ),
            True,
        ),
        (fit_of(Pose2(0.08), normalised_correlation=0.97, evidence=900.0), True),
    ],
    ids=["certain", "near", "uncertain", "explains all"],
)
def test_what_moves_does_not_pull_a_motion_away_from_where_features_certainly_put_it(
    scripted: Scripted, pulled: MotionHypothesis, kept: bool
) -> None:
    start = unsteady()
    scripted(start, pulled, None, None)
    assert refined() is (pulled if kept else start)


def test_a_steady_fit_that_is_open_is_kept_only_where_its_start_is_as_open(
    scripted: Scripted,
) -> None:
    limit = 0.015 * CALIBRATION.max_range_metres
    start = replace(unsteady(), evidence=10.0)
    for sigma, kept in ((0.99 * limit, True), (1.01 * limit, False)):
        fit = replace(unsteady(sigmas=(0.001, sigma, 0.001)), evidence=100.0)
        scripted(start, fit, None, None)
        assert refined() is (fit if kept else start)
        open_start = replace(start, predicted_covariance=fit.predicted_covariance)
        scripted(open_start, fit, None, None)
        assert refined() is fit


def test_a_search_s_start_is_refined_on_all_levels_and_never_scored(scripted: Scripted) -> None:
    fit = steady_fit()
    script = scripted(unsteady(), fit)
    assert refined(None) is fit
    assert script.calls == [(0.0, START, 3, True, False)]
    scripted(unsteady(), None, None, None)
    assert refined(None) is None


# (2) With rocking.


def test_rocking_is_tried_where_a_steady_camera_leaves_something_unexplained(
    scripted: Scripted,
) -> None:
    script = scripted(unsteady(), unsteady(), None, None)
    refined()
    assert script.tilts == [0.0, 1.0, 5.0]
    assert script.masks == 0


def test_rocking_ends_where_a_fit_is_explained(scripted: Scripted) -> None:
    fit = replace(steady_fit(), view_a_from_view_b=ROCKED)
    script = scripted(unsteady(), unsteady(), fit)
    assert refined() is fit
    assert script.tilts == [0.0, 1.0]


def test_wide_rocking_starts_at_the_narrow_fit_that_correlates_better(scripted: Scripted) -> None:
    better = replace(unsteady(), pose=Pose2(0.051), correlation=0.85)
    script = scripted(unsteady(), unsteady(), better, None)
    refined()
    assert script.calls[1] == (SIGMA, START, 2, False, False)
    assert script.calls[2] == (5.0 * SIGMA, Pose2(0.051), 2, False, True)
    script = scripted(unsteady(), unsteady(), replace(better, correlation=0.8), None)
    refined()
    assert script.calls[2] == (5.0 * SIGMA, START, 2, False, False)


@pytest.mark.parametrize(
    ("first", "tilts"),
    [
        (fit_of(START, normalised_correlation=0.8, correlation=0.8), [0, 1]),
        (
            fit_of(START, normalised_correlation=0.8, correlation=0.8, rocking_suspected=True),
            [0, 1],
        ),
        (
            fit_of(
                START,
                normalised_correlation=0.8,
                correlation=0.8,
                view_a_from_view_b=ROCKED,
            ),
            [0, 1],
        ),
        (
            fit_of(
                START,
                normalised_correlation=0.8,
                correlation=0.8,
                rocking_suspected=True,
                view_a_from_view_b=ROCKED,
            ),
            [0, 1, 5],
        ),
    ],
)
def test_from_a_search_wide_rocking_needs_a_suspicion_beside_narrow_rocking(
    scripted: Scripted, first: MotionHypothesis, tilts: list[int]
) -> None:
    script = scripted(unsteady(), first, None, None)
    refined(None)
    assert script.tilts == tilts


def test_a_far_view_is_never_compared_without_rocking(scripted: Scripted) -> None:
    script = scripted(unsteady(), unsteady(), None)
    refined(None, pair=pair_of(far=True))
    assert script.tilts == [1.0]


@pytest.mark.parametrize(
    ("suspected", "modelled", "share"),
    [(False, False, 0.6), (False, True, 0.6), (True, False, 0.97), (True, True, 1.0)],
)
def test_a_fit_with_rocking_must_leave_clearly_less_unexplained(
    suspected: bool, modelled: bool, share: float
) -> None:
    other = fit_of(
        START,
        normalised_correlation=0.8,
        rocking_suspected=suspected,
        view_a_from_view_b=ROCKED if modelled else START.matrix,
    )
    assert other.includes_rocking is modelled
    for unexplained, better in ((0.999 * share * 0.2, True), (1.001 * share * 0.2, False)):
        fit = fit_of(START, normalised_correlation=1.0 - unexplained)
        assert criteria.better(fit, other, rocking=True) is better
    evidence = replace(other, evidence=other.evidence + 1.0)
    assert criteria.better(evidence, other, rocking=False)
    assert not criteria.better(other, other, rocking=False)


# (3) With obstacles masked.


def test_obstacles_are_masked_where_most_patches_disagree_with_the_start(
    scripted: Scripted,
) -> None:
    start = unsteady(confirmed=0.49)
    script = scripted(start, unsteady(confirmed=0.49), None, None, None)
    refined()
    assert [levels for _, _, levels, _, _ in script.calls] == [2, 1, 1, 1]
    assert script.masks == 1
    script = scripted(unsteady(confirmed=0.5), unsteady(), None, None)
    refined()
    assert [levels for _, _, levels, _, _ in script.calls] == [2, 2, 2]
    assert script.masks == 0


def test_what_obstacles_pull_away_from_the_features_is_left_out(scripted: Scripted) -> None:
    start = unsteady(confirmed=0.4)
    for x, kept in ((0.0699, True), (0.0701, False)):
        pulled = replace(unsteady(confirmed=0.4), pose=Pose2(x), evidence=900.0)
        script = scripted(start, unsteady(confirmed=0.4), pulled, None, None)
        assert refined() is (pulled if kept else start)
        assert script.masks == 1


def test_what_most_of_the_floor_agrees_with_is_kept_wherever_it_is(scripted: Scripted) -> None:
    start = unsteady(confirmed=0.4)
    moved = replace(steady_fit(), pose=Pose2(0.0701))
    scripted(start, start, moved, None)
    assert refined() is moved


def test_obstacles_are_masked_anew_by_a_rocking_fit_that_correlates_better(
    scripted: Scripted,
) -> None:
    start = unsteady(confirmed=0.4)
    better = replace(start, correlation=0.85)
    script = scripted(start, start, None, better, None)
    refined()
    assert script.masks == 2


def test_all_of_the_floor_is_used_once_most_patches_agree(scripted: Scripted) -> None:
    start = unsteady(confirmed=0.4)
    agreeing = replace(steady_fit(), pose=Pose2(0.051), view_a_from_view_b=ROCKED, evidence=100.0)
    unmasked = replace(agreeing, evidence=100.1)
    script = scripted(start, start, None, agreeing, unmasked)
    assert refined() is unmasked
    assert script.calls[2] == (SIGMA, START, 1, False, False)
    assert script.calls[3] == (SIGMA, Pose2(0.051), 2, False, True)
    scripted(start, start, None, agreeing, replace(unmasked, evidence=100.0))
    assert refined() is agreeing
    scripted(start, start, None, agreeing, None)
    assert refined() is agreeing


# Criteria.


@pytest.mark.parametrize(
    ("normalised", "gray", "suspected", "explained"),
    [
        (0.95, 0.0, False, True),
        (0.949, 0.0, False, False),
        (0.95, 0.0, True, False),
        (0.5, 0.9976, False, True),
        (0.5, 0.9974, False, False),
    ],
)
def test_a_steady_camera_explains_what_correlates_well(
    normalised: float, gray: float, suspected: bool, explained: bool
) -> None:
    fit = fit_of(normalised_correlation=normalised, correlation=gray, rocking_suspected=suspected)
    assert criteria.explained_by_steady_camera(fit) is explained


@pytest.mark.parametrize(("confirmed", "obstructed"), [(0.499, True), (0.5, False), (math.nan, 0)])
def test_a_view_is_mostly_obstructed_where_fewer_than_half_of_the_patches_agree(
    confirmed: float, obstructed: bool
) -> None:
    assert criteria.mostly_obstructed(fit_of(confirmed=confirmed)) == obstructed


@pytest.mark.parametrize(
    ("moved", "diverged"),
    [
        (Pose2(0.0199), False),
        (Pose2(0.0201), True),
        (Pose2(0.0, 0.0, math.radians(0.49)), False),
        (Pose2(0.0, 0.0, math.radians(0.51)), True),
        (Pose2(0.0, 0.0, math.radians(-0.51)), True),
    ],
)
def test_a_motion_diverges_by_two_pixels_or_half_a_degree(moved: Pose2, diverged: bool) -> None:
    assert criteria.diverged(START, START @ moved, PAIR) is diverged


@pytest.mark.parametrize(
    ("guess", "correlation", "converges"),
    [(0.169, 0.97, True), (0.171, 0.97, False), (0.169, 0.9, False)],
)
def test_a_guess_near_a_fit_that_explains_all_need_not_be_refined(
    guess: float, correlation: float, converges: bool
) -> None:
    fit = fit_of(START, normalised_correlation=correlation)
    assert refinement.converges_to(PAIR, Pose2(guess), fit) is converges


@pytest.mark.parametrize(("overlap", "near"), [(0.1, True), (0.099, False)])
def test_a_far_fit_is_refined_on_the_near_view_where_that_shares_enough(
    scripted: Scripted, overlap: float, near: bool
) -> None:
    far = replace(unsteady(), evidence=7.0)
    script = scripted(unsteady(), fit_of(Pose2(0.051), overlap=overlap))
    fit = refinement.refine_on_near_view(PAIR, far, CALIBRATION, OPTIONS)
    assert script.tilts == [1.0]
    assert fit.pose == (Pose2(0.051) if near else START)
    assert (fit.evidence, fit.correlation) == (7.0, 0.8)
