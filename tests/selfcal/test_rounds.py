"""The decisions of a self-calibration, round by round: accepted, confirmed, or not applied."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from matched_drives import CHANGE, POSES, TRUE, WRONG, bundle_round

from slamcli.core.records import PoseEstimate
from slamcli.selfcal import BRIEF, THOROUGH, RegisteredDrive, refine_calibration, rounds
from slamcli.selfcal.bundle import MAX_SIGMAS
from slamcli.stages import adjustment

COUNT = len(POSES)
SURE = np.full(7, 1e-4)


def registered(calibration, placed=COUNT):
    estimates = [
        PoseEstimate(
            index,
            f"{index}.png",
            None,
            pose if index < placed else None,
            "tracked" if index < placed else "lost",
            "",
            0 if index < placed else -1,
            None,
        )
        for index, pose in POSES.items()
    ]
    return RegisteredDrive(calibration, estimates, [])


@pytest.fixture
def refine(monkeypatch):
    """Run a self-calibration whose bundle adjustments give these results, one a round."""

    def run(first, results, placed=COUNT, effort=THOROUGH):
        given = iter(results)
        monkeypatch.setattr(rounds, "adjust_drive", lambda *_args, **_options: next(given))
        done = refine_calibration(
            first,
            lambda index: pytest.fail(f"frame {index} was read"),
            lambda calibration: registered(calibration, placed),
            map,
            lambda _: 1.0,
            effort,
        )
        return done, list(given)

    return run


def test_a_better_camera_is_applied_once_its_rounds_have_converged(refine):
    results = [
        bundle_round(CHANGE, SURE),
        bundle_round(np.zeros(7), SURE),
        bundle_round(CHANGE, SURE),
    ]
    done, left = refine(registered(WRONG), results)
    assert (done.verdict, done.rounds) == ("refined", 2)
    assert len(left) == 1
    assert done.reason.startswith("focal length")
    focal = done.registration.calibration.camera_matrix[0, 0]
    assert focal == pytest.approx(TRUE.camera_matrix[0, 0])
    assert done.pixels_after < 0.2 < done.pixels_before


def test_frames_are_registered_anew_even_when_the_first_round_has_converged(refine):
    """Each parameter changes by less than its sigma, all together by many: they are correlated."""
    change = 0.4 * CHANGE
    sigmas = change / 0.9
    first_round = bundle_round(change, SURE)
    covariance = np.diag(np.where(sigmas > 0, sigmas**2, SURE**2))
    covariance[0, 3] = covariance[3, 0] = -0.999 * sigmas[0] * sigmas[3]
    found = replace(first_round.found, camera_covariance=covariance)
    results = [replace(first_round, found=found), bundle_round(np.zeros(7), SURE)]
    done, _ = refine(registered(adjustment.changed(TRUE, -change)), results)
    assert (done.verdict, done.rounds) == ("refined", 2)


def test_rounds_that_do_not_converge_end(refine):
    done, left = refine(registered(WRONG), [bundle_round(CHANGE, SURE)] * 6)
    assert (done.verdict, done.rounds) == ("refined", 4)
    assert len(left) == 2


def test_a_right_calibration_is_confirmed_with_its_poses_refined(refine):
    first = registered(TRUE)
    done, _ = refine(first, [bundle_round(np.zeros(7), SURE)])
    assert (done.verdict, done.rounds) == ("confirmed", 1)
    assert "no more than its uncertainty" in done.reason
    assert done.registration.calibration is TRUE
    assert done.registration is not first


def not_applied(done, first, words):
    assert done.verdict == "not applied"
    assert words in done.reason
    assert done.registration is first
    assert math.isnan(done.pixels_after)


def test_without_a_calibration_nothing_is_refined(refine):
    first = registered(replace(TRUE, height_metres=math.inf))
    not_applied(refine(first, [])[0], first, "no calibration")


def test_too_few_frames_in_common_are_not_enough(refine):
    first = registered(WRONG)
    not_applied(refine(first, [None])[0], first, "too few frames share floor")


def test_an_unobservable_camera_is_not_applied(refine):
    first = registered(WRONG)
    loose = bundle_round(CHANGE, 2.0 * MAX_SIGMAS)
    not_applied(refine(first, [loose])[0], first, "do not determine the focal length")


def test_a_camera_that_becomes_unobservable_is_not_applied(refine):
    first = registered(WRONG)
    results = [bundle_round(CHANGE, SURE), bundle_round(CHANGE, 2.0 * MAX_SIGMAS)]
    not_applied(refine(first, results)[0], first, "do not determine the focal length")


def test_a_camera_that_places_fewer_frames_is_not_applied(refine):
    first = registered(WRONG, COUNT - 1)
    done, _ = refine(first, [bundle_round(CHANGE, SURE)] * 2, placed=COUNT - 2)
    not_applied(done, first, "places 4 frames of 5")


def test_a_camera_with_which_a_frame_of_a_whole_map_matches_no_other_is_not_applied(refine):
    first = registered(WRONG)
    fewer = bundle_round(CHANGE, SURE)
    poses = {index: pose for index, pose in fewer.found.poses.items() if index}
    fewer = replace(fewer, found=replace(fewer.found, poses=poses))
    done, _ = refine(first, [bundle_round(CHANGE, SURE), fewer])
    not_applied(done, first, "places 5 frames of 6")


@pytest.mark.parametrize("placed", [COUNT, COUNT - 1])
def test_only_a_drive_with_lost_frames_is_registered_anew(monkeypatch, placed):
    results = iter([bundle_round(CHANGE, SURE), bundle_round(np.zeros(7), SURE)])
    monkeypatch.setattr(rounds, "adjust_drive", lambda *_args, **_options: next(results))
    cameras = []

    def register(calibration):
        cameras.append(calibration)
        return registered(calibration, placed)

    first = registered(WRONG, placed)
    done = refine_calibration(first, None, register, map, lambda _: 1.0, THOROUGH)
    assert done.verdict == "refined"
    assert len(cameras) == (placed < COUNT)


def test_a_camera_with_which_frames_no_longer_overlap_is_not_applied(refine):
    first = registered(WRONG)
    not_applied(refine(first, [bundle_round(CHANGE, SURE), None])[0], first, "too few frames")


def test_a_camera_that_is_no_better_in_the_end_is_not_applied(refine):
    """Better than the calibration in the first round, worse in the last."""
    first = registered(WRONG)
    worse = bundle_round(np.zeros(7), SURE)
    other = adjustment.changed(TRUE, -2.0 * CHANGE)
    worse = replace(worse, found=replace(worse.found, calibration=other))
    not_applied(refine(first, [bundle_round(CHANGE, SURE), worse])[0], first, "no better")


@pytest.mark.parametrize("lost", [0, 1])
def test_in_brief_frames_are_registered_anew_only_where_some_are_lost(refine, lost):
    results = [bundle_round(CHANGE, SURE), bundle_round(np.zeros(7), SURE)]
    done, left = refine(registered(WRONG, COUNT - lost), results, effort=BRIEF)
    assert (done.verdict, done.rounds) == ("refined", 1 + lost)
    assert len(left) == 1 - lost
