"""The steps of a registration: features, then pixels near a guess or in a window, then far view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hand_made_records import alignment_of, fit_of, pair_of

from slamcli.core.config import MapperOptions
from slamcli.core.deferred import Deferred
from slamcli.core.geometry import Pose2
from slamcli.core.records import FeatureAlignment, Features, PreparedFrame, Pyramids
from slamcli.registration import (
    RegistrationResult,
    confidence,
    hypotheses,
    refinement,
    register,
    rivals,
)
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.simulation import photograph
from slamcli.simulation.config import CameraOptions
from slamcli.stages import align, dense

CALIBRATION = photograph.make_camera(CameraOptions(size=(400, 300)))
NO_FEATURES = Features(
    np.empty((0, 2), np.float32),
    np.empty((0, 32), np.uint8),
    np.empty(0, np.float32),
    np.empty((0, 2), np.float32),
    np.empty(0, np.float32),
    np.empty(0, np.float32),
)
# The steps are what is tested, not the scores of fits that are made by hand.
ANY_SCORE = MapperOptions(min_score=0.0, min_score_alone=0.0)
HERE, GUESS, THERE = Pose2(0.05), Pose2(0.3), Pose2(0.5)
WINDOW = dense.SearchWindow(HERE, 0.5, 0.2)
FOUND = dense.Search((), np.zeros((1, 1), np.float32), 0.04)
# What the features' motion may be: convincing, contradicted by the pixels, or not convincing.
CONVINCING = fit_of(HERE)
CONTRADICTED = fit_of(HERE, overlap=0.05)
DISSIMILAR = fit_of(HERE, correlation=0.4, confirmed=0.34)


def frame_of(index: int, *, far: bool = False, repeats: bool = False) -> PreparedFrame:
    levels = pair_of().a
    shifts = np.array([[0.3, 0.0]]) if repeats else np.empty((0, 2))
    far_levels = levels if far else ()
    return PreparedFrame(
        index,
        f"frame {index}",
        None,
        None,
        Deferred.of(NO_FEATURES),
        "",
        Deferred.of(Pyramids(levels, far_levels)),
        periodicity=Deferred.of(shifts),
    )


@dataclass
class Steps:
    """The steps that a registration took, and what each of them finds."""

    alignments: list[FeatureAlignment]
    by_features: MotionHypothesis | None = None
    near_guess: MotionHypothesis | None = None
    near: list[MotionHypothesis] = field(default_factory=list)
    far: list[MotionHypothesis] = field(default_factory=list)
    taken: list[str] = field(default_factory=list)
    windows: list[dense.SearchWindow] = field(default_factory=list)
    guesses: list[object] = field(default_factory=list)

    def align(self, *given: object) -> FeatureAlignment:
        guess = given[3]
        self.guesses.append(guess)
        self.taken.append("match" if guess is None else "match near")
        return self.alignments[0] if len(self.alignments) == 1 else self.alignments.pop(0)

    def refine_hypothesis(self, *given: object) -> MotionHypothesis | None:
        if given[2] is None:
            self.taken.append("refine guess")
            return self.near_guess
        self.taken.append("refine features")
        return self.by_features

    def search(
        self, pair: PyramidPair, window: dense.SearchWindow, *given: object
    ) -> tuple[dense.Search, list[MotionHypothesis]]:
        self.taken.append("search far" if pair.far else "search near")
        self.windows.append(window)
        return FOUND, self.far if pair.far else self.near


Scripted = Callable[..., Steps]


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch) -> Scripted:
    def follow(
        inliers: int | list[int], by_features: MotionHypothesis | None, **others: object
    ) -> Steps:
        counts = [inliers] if isinstance(inliers, int) else inliers
        reason = "" if by_features is not None else "too few matches"
        steps = Steps([alignment_of(n, HERE, reason) for n in counts], by_features)
        for name, value in others.items():
            setattr(steps, name, value)
        monkeypatch.setattr(align, "align", steps.align)
        monkeypatch.setattr(refinement, "refine_hypothesis", steps.refine_hypothesis)
        monkeypatch.setattr(
            refinement, "refine_on_near_view", lambda near, fit, calibration, options: fit
        )
        monkeypatch.setattr(hypotheses, "search", steps.search)
        monkeypatch.setattr(hypotheses, "preferred", lambda *given: False)
        return steps

    return follow


def registered(
    guess: Pose2 | None = None,
    window: dense.SearchWindow | None = None,
    expected: Pose2 | None = None,
    *,
    options: MapperOptions | None = None,
    far: bool = False,
    repeats: bool = False,
) -> RegistrationResult:
    return register(
        frame_of(0, far=far),
        frame_of(1, far=far, repeats=repeats),
        guess,
        CALIBRATION,
        ANY_SCORE if options is None else options,
        window=window,
        prior=None if expected is None else dense.MotionPrior(expected, np.eye(3)),
    )


@pytest.mark.parametrize(("guess", "window"), [(None, None), (None, WINDOW), (GUESS, None)])
def test_convincing_features_need_no_pixels_searched(
    scripted: Scripted, guess: Pose2 | None, window: dense.SearchWindow | None
) -> None:
    steps = scripted(120, CONVINCING)
    result = registered(guess, window)
    assert result.link is not None
    assert result.link.inliers == 120
    assert result.fit is CONVINCING
    assert steps.taken == ["match" if guess is None else "match near", "refine features"]


def test_without_pixels_too_few_features_are_not_even_refined(scripted: Scripted) -> None:
    steps = scripted(119, CONVINCING)
    result = registered()
    assert (result.link, result.fit) == (None, None)
    assert result.reason.startswith("119 inliers without the pixels' confirmation are too few")
    assert steps.taken == ["match"]


def test_without_pixels_features_that_do_not_convince_are_rejected(scripted: Scripted) -> None:
    scripted(120, DISSIMILAR)
    result = registered()
    assert (result.link, result.fit) == (None, DISSIMILAR)
    assert result.reason == "the pixels do not confirm the 120 inliers (to frame 0)"


def test_without_pixels_features_that_a_gate_contradicts_are_rejected(scripted: Scripted) -> None:
    scripted(120, CONTRADICTED)
    result = registered()
    assert (result.link, result.fit) == (None, CONTRADICTED)
    assert result.reason.startswith("the fit leaves an overlap")


def test_without_pixels_a_motion_that_no_robot_makes_is_no_fit(scripted: Scripted) -> None:
    scripted(120, DISSIMILAR)
    result = registered(options=replace(ANY_SCORE, max_step_metres=0.04))
    assert (result.link, result.fit) == (None, None)


@pytest.mark.parametrize("inliers", [20, 120])
def test_plain_registration_by_features_needs_no_convincing_number(
    scripted: Scripted, inliers: int
) -> None:
    steps = scripted(inliers, fit_of(HERE, correlation=0.4, confirmed=0.5))
    options = MapperOptions(dense=False)
    assert registered(None, WINDOW, options=options).link is not None
    assert registered(GUESS, options=options).link is not None
    assert "search near" not in steps.taken
    steps = scripted(inliers, fit_of(HERE, correlation=0.29, confirmed=0.49))
    for guess, window in ((None, None), (None, WINDOW), (GUESS, None)):
        assert registered(guess, window, options=options).reason.startswith("the pixels disagree")
    assert set(steps.taken) <= {"match", "match near", "refine features"}


def test_beside_many_features_fewer_patches_need_to_agree(scripted: Scripted) -> None:
    scripted(120, fit_of(HERE, correlation=0.29, confirmed=0.35))
    assert registered().link is not None


def test_many_features_on_a_floor_that_repeats_may_be_ambiguous(
    scripted: Scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    scripted(120, CONVINCING)
    alternatives = [fit_of(THERE, evidence=80.0)]
    monkeypatch.setattr(rivals, "refined", lambda *given: iter(alternatives))
    assert registered(repeats=True).reason.startswith("ambiguous: the floor repeats")


@pytest.mark.parametrize(
    ("inliers", "by_features"),
    [(50, DISSIMILAR), (50, CONTRADICTED), (119, CONTRADICTED), (50, None)],
)
def test_near_a_guess_the_pixels_decide_where_features_do_not(
    scripted: Scripted, inliers: int, by_features: MotionHypothesis | None
) -> None:
    near_guess = fit_of(GUESS, evidence=200.0)
    steps = scripted(inliers, by_features, near_guess=near_guess)
    result = registered(GUESS, WINDOW)
    assert result.link is not None
    assert result.fit is near_guess
    assert result.search is None
    assert steps.taken[-1] == "refine guess"


def test_a_guess_that_the_features_motion_answers_is_not_refined(scripted: Scripted) -> None:
    fit = fit_of(HERE, normalised_correlation=0.97)
    steps = scripted(50, fit)
    assert registered(Pose2(0.1)).fit is fit
    assert steps.taken == ["match near", "refine features"]
    # On all levels, then on the finest alone.
    steps = scripted(50, fit, near_guess=None)
    assert registered(GUESS).fit is fit
    assert steps.taken == ["match near", "refine features", "refine guess", "refine guess"]


@pytest.mark.parametrize(
    ("inliers", "by_features"),
    [(50, DISSIMILAR), (50, CONTRADICTED), (119, CONTRADICTED), (50, None)],
)
def test_in_a_window_the_pixels_are_searched_where_features_do_not_convince(
    scripted: Scripted, inliers: int, by_features: MotionHypothesis | None
) -> None:
    found = fit_of(THERE, evidence=200.0)
    steps = scripted(inliers, by_features, near=[found])
    result = registered(window=WINDOW, options=replace(ANY_SCORE, max_step_metres=0.6), far=True)
    assert result.link is not None
    assert result.fit is found
    assert result.search is FOUND
    assert steps.taken[-1] == "search near"
    assert steps.windows == [replace(WINDOW, max_displacement_metres=0.6)]


def test_many_features_that_a_gate_contradicts_leave_it_to_the_pixels(scripted: Scripted) -> None:
    steps = scripted(120, CONTRADICTED, near=[fit_of(Pose2(0.06), evidence=200.0)])
    assert registered(window=WINDOW).link is not None
    assert steps.taken == ["match", "refine features", "search near"]


def test_a_search_competes_with_no_motion_that_no_robot_makes(scripted: Scripted) -> None:
    found, farther = fit_of(HERE), fit_of(THERE, correlation=0.4, confirmed=0.34, evidence=500.0)
    scripted(50, farther, near=[found])
    result = registered(window=WINDOW, options=replace(ANY_SCORE, max_step_metres=0.1))
    assert result.link is not None
    assert result.fit is found


def test_the_far_view_is_searched_last_and_only_where_there_is_one(scripted: Scripted) -> None:
    near, far = fit_of(HERE, overlap=0.05), fit_of(THERE)
    steps = scripted(20, None, near=[near], far=[far])
    result = registered(window=WINDOW, far=True)
    assert result.fit is far
    assert result.link is not None
    assert steps.taken == ["match", "search near", "search far"]
    steps = scripted(20, None, near=[near], far=[far])
    assert registered(window=WINDOW).fit is near
    assert steps.taken == ["match", "search near"]


def test_where_the_far_view_gives_no_link_either_the_near_result_is_kept(
    scripted: Scripted,
) -> None:
    near = fit_of(HERE, overlap=0.05)
    scripted(20, None, near=[near], far=[fit_of(THERE, overlap=0.05)])
    assert registered(window=WINDOW, far=True).fit is near


def test_matches_near_an_expected_motion_save_the_others_where_they_are_accepted(
    scripted: Scripted,
) -> None:
    steps = scripted([120, 121], CONVINCING)
    result = registered(expected=GUESS)
    assert result.alignment.inlier_count == 120
    assert steps.taken == ["match near", "refine features"]


@pytest.mark.parametrize(
    ("inliers", "fit", "taken"),
    [
        (119, CONVINCING, ["match near", "match", "refine features"]),
        (120, CONTRADICTED, ["match near", "refine features", "match", "refine features"]),
        (120, DISSIMILAR, ["match near", "refine features", "match", "refine features"]),
    ],
    ids=["few", "contradicted", "dissimilar"],
)
def test_otherwise_an_expected_motion_is_no_evidence(
    scripted: Scripted, inliers: int, fit: MotionHypothesis, taken: list[str]
) -> None:
    steps = scripted([inliers, 150], fit)
    result = registered(expected=GUESS)
    assert result.alignment.inlier_count == 150
    assert steps.taken == taken


def test_no_motion_is_expected_beside_a_guess_or_on_a_floor_that_repeats(
    scripted: Scripted, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rivals, "refined", lambda *given: iter([]))
    steps = scripted(120, CONVINCING)
    registered(expected=GUESS, repeats=True)
    assert steps.taken == ["match", "refine features"]
    steps = scripted(120, CONVINCING)
    registered(GUESS, expected=THERE)
    assert steps.taken == ["match near", "refine features"]
    assert steps.guesses == [GUESS]


@pytest.mark.parametrize(
    ("guess", "radius", "share"), [(None, 0.2, 0.2), (GUESS, 0.2, 0.0), (None, math.inf, math.inf)]
)
def test_how_far_was_searched_is_evidence_against_a_motion(
    scripted: Scripted, guess: Pose2 | None, radius: float, share: float
) -> None:
    scripted(20, None, near=[fit_of(HERE)], near_guess=fit_of(HERE))
    result = registered(guess, replace(WINDOW, radius_metres=radius))
    assert result.evidence is not None
    far_and_wide = result.evidence[confidence.EVIDENCE.index("searched far and wide")]
    assert far_and_wide == min(share / CALIBRATION.max_range_metres, 1.0)
