"""The selection among hypotheses: the order of the gates, and the verdict they come to."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hand_made_records import alignment_of, fit_of, frame_of, pair_of

from slamcli.core.arrays import Float64Array
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.registration import confidence, hypotheses, rivals
from slamcli.registration.hypothesis import MotionHypothesis, PyramidPair
from slamcli.registration.marks import RepeatMarks
from slamcli.registration.result import ACCEPTED, RegistrationResult, Verdict
from slamcli.registration.selection import PairContext
from slamcli.simulation import photograph
from slamcli.simulation.config import CameraOptions
from slamcli.stages import dense

CALIBRATION = photograph.make_camera(CameraOptions(size=(400, 300)))
PAIR = pair_of()
HERE, ELSEWHERE = Pose2(0.05), Pose2(0.35)
OPEN = (0.001, 0.2, 0.001)


def context_of(
    inliers: int = 20,
    options: MapperOptions | None = None,
    repeats: Float64Array | None = None,
    reason: str = "",
) -> PairContext:
    return PairContext(
        frame_of(3),
        frame_of(4, repeats),
        alignment_of(inliers, HERE, reason),
        CALIBRATION,
        MapperOptions() if options is None else options,
        0.2,
    )


@pytest.fixture
def votes(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Set whether patches prefer the best motion to every rival."""

    def vote(preferred: bool) -> None:
        monkeypatch.setattr(hypotheses, "preferred", lambda pair, fit, rival: preferred)
        monkeypatch.setattr(RepeatMarks, "rule_out", lambda marks, rival, fit: False)

    vote(False)
    return vote


def chosen(
    context: PairContext, *fits: MotionHypothesis, by_features: MotionHypothesis | None = None
) -> RegistrationResult:
    return context.choose(PAIR, fits, by_features, None)


def test_the_verdict_of_a_gate_is_rejected_with_its_reason_or_accepted() -> None:
    assert Verdict.of("") == ACCEPTED == Verdict("accepted")
    assert Verdict.of("too far") == Verdict("rejected", "too far")


def test_an_accepted_motion_becomes_a_link() -> None:
    fit = fit_of(HERE)
    result = context_of(30).result(fit, ACCEPTED)
    assert result.link is not None
    assert (result.link.a, result.link.b, result.link.kind) == (3, 4, "step")
    assert result.link.inliers == 30
    assert result.link.score == result.score
    assert (result.fit, result.partial, result.reason) == (fit, None, "")
    assert math.isnan(result.rival)


def test_a_motion_that_the_pixels_chose_is_no_motion_of_inliers() -> None:
    link = context_of(30).result(fit_of(HERE), ACCEPTED, 0.2).link
    assert link is not None
    assert link.inliers == 0


def test_a_partial_motion_becomes_a_partial_link_and_keeps_its_reason() -> None:
    result = context_of().result(fit_of(HERE), Verdict("partial", "open"), 0.1)
    assert result.link is None
    assert result.partial is not None
    assert result.partial.kind == "partial"
    assert result.reason == "open (to frame 3)"


@pytest.mark.parametrize("verdict", [Verdict("rejected", "no"), Verdict("inconclusive", "no")])
def test_any_other_motion_becomes_no_link(verdict: Verdict) -> None:
    result = context_of().result(fit_of(HERE), verdict)
    assert (result.link, result.partial, result.reason) == (None, None, "no (to frame 3)")
    assert result.evidence is not None


def test_without_any_fit_the_features_reason_is_given() -> None:
    assert chosen(context_of(reason="3 matches")).reason == "3 matches (to frame 3)"
    result = chosen(context_of())
    assert result.reason == "the pixels determine no motion (to frame 3)"
    assert (result.fit, result.evidence, result.score) == (None, None, 0.0)
    assert result.rival == 1.0


def test_the_motion_with_the_most_evidence_is_chosen(votes: Callable[[bool], None]) -> None:
    weak, strong = fit_of(ELSEWHERE, evidence=70.0), fit_of(HERE, evidence=100.0)
    result = chosen(context_of(), weak, strong)
    assert result.link is not None
    assert result.fit is strong
    assert result.rival == pytest.approx(0.7)


@pytest.mark.parametrize(("share", "ambiguous"), [(0.75, False), (0.751, True)])
def test_a_rival_that_patches_do_not_rule_out_makes_it_ambiguous(
    votes: Callable[[bool], None], share: float, ambiguous: bool
) -> None:
    rival = fit_of(ELSEWHERE, evidence=100.0 * share)
    result = chosen(context_of(), rival, fit_of(HERE, evidence=100.0))
    assert result.reason.startswith("ambiguous") is ambiguous
    assert result.rival == pytest.approx(share)
    votes(True)
    result = chosen(context_of(), rival, fit_of(HERE, evidence=100.0))
    assert result.link is not None
    assert result.rival == pytest.approx(0.0 if ambiguous else share)


def test_a_rival_is_one_even_where_nothing_is_evidence(votes: Callable[[bool], None]) -> None:
    result = chosen(context_of(), fit_of(HERE, evidence=0.0), fit_of(ELSEWHERE, evidence=0.0))
    assert result.rival == 1.0
    assert result.reason.startswith("ambiguous")


def test_an_open_motion_is_partial_and_no_motion_along_it_is_its_rival(
    votes: Callable[[bool], None],
) -> None:
    best = fit_of(HERE, sigmas=OPEN)
    along, across = Pose2(0.05, 0.5), Pose2(0.35)
    result = chosen(context_of(), best, fit_of(along, evidence=99.0))
    assert result.link is None
    assert result.partial is not None
    assert result.rival == 0.0
    result = chosen(context_of(), best, fit_of(across, evidence=99.0))
    assert (result.link, result.partial) == (None, None)
    assert result.reason.startswith("ambiguous")


def test_an_open_motion_that_a_gate_rejects_is_no_partial_link() -> None:
    result = chosen(context_of(), fit_of(HERE, sigmas=OPEN, overlap=0.05))
    assert (result.link, result.partial) == (None, None)
    assert result.reason.startswith("the fit leaves an overlap")


@pytest.mark.parametrize(("inliers", "linked"), [(36, True), (35, False)])
def test_enough_features_back_an_open_motion_of_dissimilar_pixels(
    votes: Callable[[bool], None], inliers: int, linked: bool
) -> None:
    fit = fit_of(HERE, sigmas=OPEN, correlation=0.4, confirmed=0.4)
    result = chosen(context_of(inliers), by_features=fit)
    assert (result.link is not None) is linked
    if not linked:
        assert result.reason.startswith("the views are too dissimilar")


@pytest.mark.parametrize(("inliers", "rejected"), [(119, False), (120, True)])
def test_pixels_do_not_outvote_enough_features(
    votes: Callable[[bool], None], inliers: int, rejected: bool
) -> None:
    features = fit_of(HERE, evidence=10.0)
    result = chosen(context_of(inliers), fit_of(ELSEWHERE), by_features=features)
    assert (result.link is None) is rejected
    if rejected:
        assert result.reason.startswith("the pixels support another motion")


def test_features_back_no_motion_that_contradicts_theirs(votes: Callable[[bool], None]) -> None:
    features = fit_of(HERE, evidence=10.0)
    dissimilar = fit_of(ELSEWHERE, correlation=0.4, confirmed=0.4)
    result = chosen(context_of(36), dissimilar, by_features=features)
    assert result.fit is dissimilar
    assert result.reason.startswith("the views are too dissimilar")


@pytest.mark.parametrize(("step", "linked"), [(0.05, True), (0.049, False)])
def test_no_motion_is_farther_than_a_step(step: float, linked: bool) -> None:
    options = MapperOptions(max_step_metres=step)
    result = chosen(context_of(options=options), fit_of(HERE))
    assert (result.link is not None) is linked


def test_motions_of_obstacles_are_left_out_where_features_back_another(
    votes: Callable[[bool], None],
) -> None:
    features = fit_of(HERE, confirmed=0.3, evidence=50.0)
    context = context_of(36)
    # Elsewhere, and implausible: what obstacles make of the floor's motion.
    result = chosen(context, fit_of(ELSEWHERE, confirmed=0.2), by_features=features)
    assert result.fit is features
    # Here, and obstructed as the features' own fit is.
    nearby = fit_of(Pose2(0.06), confirmed=0.4, evidence=90.0)
    assert chosen(context, nearby, by_features=features).fit is features
    # Here, and most of the floor agrees: rocking was what made it disagree.
    agreeing = replace(nearby, agreement=replace(nearby.agreement, confirmed=0.6))
    assert chosen(context, agreeing, by_features=features).fit is agreeing
    # Too few features back nothing.
    assert chosen(context_of(35), nearby, by_features=features).fit is nearby


@pytest.mark.parametrize(
    ("alternative", "preferred", "step", "ambiguous"),
    [
        (fit_of(ELSEWHERE, evidence=80.0), False, None, True),
        (fit_of(ELSEWHERE, evidence=70.0), False, None, True),
        (fit_of(ELSEWHERE, overlap=0.39, evidence=75.0), False, None, False),
        (fit_of(ELSEWHERE, overlap=0.39, evidence=75.1), False, None, True),
        (fit_of(ELSEWHERE, correlation=0.77, confirmed=0.69), False, None, False),
        (fit_of(ELSEWHERE, correlation=0.78, confirmed=0.69), False, None, True),
        (fit_of(ELSEWHERE, correlation=0.77, confirmed=0.7), False, None, True),
        (fit_of(ELSEWHERE, correlation=0.2, confirmed=0.3), False, None, False),
        (fit_of(ELSEWHERE, evidence=80.0), True, None, False),
        (fit_of(ELSEWHERE, evidence=80.0), False, 0.349, False),
        (fit_of(ELSEWHERE, evidence=80.0), False, 0.35, True),
    ],
    ids=[
        "alike",
        "fewer pixels",
        "a weak strip",
        "a strip",
        "explains less",
        "explains about as much",
        "explains all but brightness",
        "no fit",
        "pixels decide",
        "too far",
        "within a step",
    ],
)
def test_a_floor_that_repeats_makes_a_motion_ambiguous(
    monkeypatch: pytest.MonkeyPatch,
    votes: Callable[[bool], None],
    alternative: MotionHypothesis,
    preferred: bool,
    step: float | None,
    ambiguous: bool,
) -> None:
    votes(preferred)
    monkeypatch.setattr(rivals, "refined", lambda *given: iter([alternative]))
    monkeypatch.setattr(RepeatMarks, "support", lambda *given: True)
    options, repeats = MapperOptions(max_step_metres=step), np.array([[0.3, 0.0]])
    context = context_of(options=options, repeats=repeats)
    reason = context.check_rivals(PAIR, fit_of(HERE))
    assert reason.startswith("ambiguous: the floor repeats") is ambiguous
    assert bool(reason) is ambiguous
    result = chosen(context, fit_of(HERE))
    assert (result.link is None) is ambiguous
    assert result.reason == (f"{reason} (to frame 3)" if ambiguous else "")
    far = PyramidPair(PAIR.a, PAIR.b, far=True)
    assert context.check_rivals(far, fit_of(HERE)) == ""


def test_a_narrow_rival_remains_where_no_marks_support_a_motion(
    monkeypatch: pytest.MonkeyPatch, votes: Callable[[bool], None]
) -> None:
    votes(False)
    strip = fit_of(ELSEWHERE, overlap=0.39, evidence=20.0)
    monkeypatch.setattr(rivals, "refined", lambda *given: iter([strip]))
    context = context_of(repeats=np.array([[0.3, 0.0]]))
    for supported in (True, False):
        monkeypatch.setattr(RepeatMarks, "support", lambda *given, value=supported: value)
        reason = context.check_rivals(PAIR, fit_of(HERE))
        assert reason.startswith("ambiguous: the floor repeats") is not supported


def test_a_period_along_the_open_direction_is_no_ambiguity(
    monkeypatch: pytest.MonkeyPatch, votes: Callable[[bool], None]
) -> None:
    along = fit_of(Pose2(0.05, 0.3), evidence=90.0)
    monkeypatch.setattr(rivals, "refined", lambda *given: iter([along]))
    context, best = context_of(repeats=np.array([[0.0, 0.3]])), fit_of(HERE, sigmas=OPEN)
    assert context.check_rivals(PAIR, best, is_open=True) == ""
    assert context.check_rivals(PAIR, best).startswith("ambiguous")
    assert chosen(context, best).partial is not None


def test_the_prior_chooses_among_motions_that_the_pixels_support_alike(
    monkeypatch: pytest.MonkeyPatch, votes: Callable[[bool], None]
) -> None:
    """A period on, expected or not; and what is expected where the fit surprises."""
    votes(False)
    begun: list[list[Pose2]] = []
    monkeypatch.setattr(
        rivals, "refined", lambda pair, fit, starts, calibration: begun.append(starts) or iter([])
    )
    period = np.array([[0.3, 0.0]])
    overlaps = [0.2]
    monkeypatch.setattr(dense, "agreement", lambda *given: dense.Agreement(0.9, overlaps[0], 0.9))

    def starts(prior: Pose2 | None, sigma: float, confirmed: float = 0.95) -> list[float]:
        context = replace(
            context_of(repeats=period),
            prior=None if prior is None else dense.MotionPrior(prior, sigma**2 * np.eye(3)),
        )
        context.check_rivals(PAIR, fit_of(HERE, confirmed=confirmed))
        return sorted(round(start.x, 9) for start in begun.pop())

    assert starts(None, 1.0) == [-0.25, 0.35]
    assert starts(HERE, 0.01) == []
    assert starts(HERE, 0.049) == []
    assert starts(HERE, 0.051) == [-0.25, 0.35]
    # What the fit leaves unexplained, a motion that is not expected may explain.
    assert starts(HERE, 0.01, confirmed=0.949) == [-0.25, 0.35]
    # The fit itself is excluded: the expected motion is a rival beside those of the floor.
    assert starts(ELSEWHERE, 0.01) == [-0.25, 0.35, 0.35]
    # Where the expected motion shares too little floor the pixels cannot tell.
    overlaps[0] = 0.19
    prior = dense.MotionPrior(ELSEWHERE, 0.01**2 * np.eye(3))
    reason = replace(context_of(), prior=prior).check_rivals(PAIR, fit_of(HERE))
    assert reason.startswith("ambiguous: the robot is expected 0.3 farther on")


@pytest.mark.parametrize("preferred", [False, True])
def test_an_unexpected_motion_counts_only_where_the_pixels_prefer_it(
    monkeypatch: pytest.MonkeyPatch, preferred: bool
) -> None:
    alike = fit_of(ELSEWHERE, confirmed=0.9)
    monkeypatch.setattr(rivals, "refined", lambda *given: iter([alike]))
    monkeypatch.setattr(
        hypotheses, "preferred", lambda pair, fit, rival: fit is alike and preferred
    )
    prior = dense.MotionPrior(HERE, 0.01**2 * np.eye(3))
    context = replace(context_of(repeats=np.array([[0.3, 0.0]])), prior=prior)
    assert bool(context.check_rivals(PAIR, fit_of(HERE))) is preferred


def test_a_motion_that_explains_much_more_is_chosen_over_a_wider_overlap() -> None:
    """Squared paper: the grid fits over nearly all of the view, the writing only elsewhere."""
    grid = fit_of(HERE, correlation=0.65, overlap=0.94, confirmed=0.51, evidence=200.0)
    writing = fit_of(ELSEWHERE, correlation=0.89, overlap=0.59, confirmed=0.57, evidence=100.0)
    context = context_of(0, reason="too few")
    assert chosen(context, grid, writing).fit is writing
    strip = replace(writing, agreement=replace(writing.agreement, overlap=0.37))
    assert chosen(context, grid, strip).fit is grid
    agreed = replace(grid, agreement=replace(grid.agreement, confirmed=0.7))
    assert chosen(context, agreed, writing).fit is agreed


def test_a_motion_that_nothing_supports_needs_a_high_score(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No patches, features or prior: bare lines that fit elsewhere had scores up to 0.83."""
    scores = [0.89]
    monkeypatch.setattr(confidence, "score", lambda evidence: scores[0])

    def result(inliers: int, expected: Pose2 | None = None, sigma: float = 0.01) -> str:
        prior = None if expected is None else dense.MotionPrior(expected, sigma**2 * np.eye(3))
        context = replace(context_of(inliers), prior=prior)
        fit = fit_of(HERE, confirmed=math.nan)
        return context.result(fit, ACCEPTED, 0.2).reason

    assert result(35) == "the score is 0.89; at least 0.90 is needed (to frame 3)"
    assert result(36) == ""
    assert result(0, HERE) == ""
    assert result(0, ELSEWHERE) != ""
    # What is expected within the free motion of a step supports nothing.
    assert result(0, HERE, sigma=0.11 * CALIBRATION.max_range_metres) != ""
    # Informative patches do.
    assert context_of(0).result(fit_of(HERE), ACCEPTED, 0.2).reason == ""
    scores[0] = 0.9
    assert result(0) == ""


def test_a_motion_over_many_features_may_be_less_certain() -> None:
    """A camera that rocks over asphalt."""
    sigma = 0.01 * CALIBRATION.max_range_metres
    fit = fit_of(HERE, sigmas=(0.001, sigma, 0.001))
    assert context_of(35)._check_observable(fit) != ""
    assert context_of(36)._check_observable(fit) == ""


@pytest.mark.parametrize(
    ("confirmed", "inliers", "metres_off", "accepted"),
    [
        (math.nan, 5, 0.01, True),
        (math.nan, 5, 0.1, False),
        (1.0, 5, 0.1, True),
        (math.nan, 40, 0.1, True),
    ],
    ids=["as expected", "elsewhere", "by patches", "by features"],
)
def test_what_only_lines_show_must_be_expected(
    monkeypatch: pytest.MonkeyPatch,
    confirmed: float,
    inliers: int,
    metres_off: float,
    accepted: bool,
) -> None:
    monkeypatch.setattr(confidence, "score", lambda evidence: 0.95)
    fit = fit_of(HERE, confirmed=confirmed)
    expected = dense.MotionPrior(HERE @ Pose2(metres_off), np.diag([0.01, 0.01, 0.01]) ** 2)
    context = replace(context_of(inliers), prior=expected)
    result = context.result(fit, ACCEPTED, 0.0)
    assert (result.link is not None) is accepted
    assert ("the robot is expected 0.1 farther on" in result.reason) is not accepted
    assert replace(context, prior=None).result(fit, ACCEPTED, 0.0).link is not None
