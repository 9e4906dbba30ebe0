"""Validation of an adjusted camera, on adjustments made by hand and matches without images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matched_drives import CHANGE, TRUE, WRONG, bundle_round

from slamcli.selfcal import validation
from slamcli.selfcal.bundle import MAX_SIGMAS
from slamcli.selfcal.validation import explains_better, has_converged, is_confirmed, unobservable


@pytest.mark.parametrize(
    ("parameter", "words"), [(0, "the focal length"), (3, "the pitch"), (4, "the roll")]
)
def test_a_parameter_with_a_large_sigma_is_named_as_unobservable(parameter, words):
    sigmas = 0.99 * MAX_SIGMAS
    assert unobservable(bundle_round(sigmas=sigmas).found) == ""
    sigmas[parameter] = 1.01 * MAX_SIGMAS[parameter]
    reason = unobservable(bundle_round(sigmas=sigmas).found)
    assert f"do not determine {words} (±" in reason
    assert reason.count("±") == 1


def test_an_uncertain_lens_alone_does_not_make_a_camera_unobservable():
    sigmas = 0.5 * MAX_SIGMAS
    sigmas[[1, 2, 5, 6]] = 1.0
    assert unobservable(bundle_round(sigmas=sigmas).found) == ""


def test_rounds_converge_when_no_parameter_changes_by_more_than_its_sigma():
    sigmas = np.full(7, 1e-3)
    assert has_converged(bundle_round(0.9 * sigmas, sigmas).found)
    change = 0.9 * sigmas
    change[4] = -1.1e-3
    assert not has_converged(bundle_round(change, sigmas).found)
    # A parameter that is known perfectly may still change by what nobody notices.
    assert has_converged(bundle_round(np.full(7, 1e-6), np.zeros(7)).found)


def test_the_camera_that_made_the_matches_explains_them_better():
    found = bundle_round()
    assert explains_better(WRONG, found)
    swapped = replace(found, found=replace(found.found, calibration=WRONG))
    assert not explains_better(TRUE, swapped)


def test_poses_are_fitted_to_other_matches_than_the_errors_are_measured_on(monkeypatch):
    found, fitted, measured = bundle_round(), [], []

    def fit(calibration, poses, matches, *_):
        fitted.append(matches)
        return replace(found.found, calibration=calibration)

    def residual_lengths(_calibration, _poses, matches):
        measured.append(matches)
        return np.ones(1)

    monkeypatch.setattr(validation, "fit", fit)
    monkeypatch.setattr(validation.adjustment, "residual_lengths", residual_lengths)
    explains_better(WRONG, found)
    for pair, used, held_out in zip(found.matches, fitted[0], measured[0], strict=True):
        np.testing.assert_array_equal(held_out.pixels_b, pair.pixels_b[::4])
        np.testing.assert_array_equal(used.pixels_b, np.delete(pair.pixels_b, np.s_[::4], axis=0))


def test_the_same_camera_is_not_better_than_itself():
    assert not explains_better(TRUE, bundle_round())


def test_a_calibration_is_confirmed_by_an_insignificant_change():
    reason = is_confirmed(WRONG, bundle_round(sigmas=np.full(7, 0.02)))
    assert "no more than its uncertainty" in reason


def test_a_calibration_is_confirmed_when_a_significant_change_does_not_generalise():
    """The change is large by its sigmas, but held-out matches are explained as well without it."""
    assert "held-out matches no better" in is_confirmed(TRUE, bundle_round(sigmas=np.full(7, 1e-4)))


def test_a_wrong_calibration_is_not_confirmed():
    assert is_confirmed(WRONG, bundle_round(sigmas=np.full(7, 1e-4))) == ""


def test_fixed_parameters_do_not_count_in_the_change():
    """Only pitch is estimated, and that changed by less than its sigma."""
    sigmas = np.zeros(7)
    sigmas[3] = 2.0 * CHANGE[3]
    assert "no more than its uncertainty" in is_confirmed(WRONG, bundle_round(sigmas=sigmas))
