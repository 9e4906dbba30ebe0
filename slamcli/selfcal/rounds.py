"""Register, explain, and register again with what came of it, until it stays the same."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.selfcal.apply import told, with_range, with_views
from slamcli.selfcal.bundle import (
    NONE,
    BundleRound,
    InOrder,
    RegisteredDrive,
    fit,
    median_pixels,
    survey_frames,
)
from slamcli.selfcal.correspondences import Read
from slamcli.selfcal.validation import explains_better, has_converged, is_confirmed, unobservable

_MAX_ROUNDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibration:
    """What came of it.

    Attributes
    ----------
    registration : RegisteredDrive
        With refined camera and poses where they are believed, else as it was given.
    verdict : str
        ``refined``, ``confirmed`` (the calibration is right; poses refined), or ``not applied``.
    reason : str
        In words.
    rounds : int
    pixels_before, pixels_after : float
        Median distance between where a spot is seen and where the camera and the poses put it, of
        spots known in both directions; with the calibration's camera and without rocking, and as
        refined. Nan when not measured.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and height (as a share) vary from frame to frame.
    """

    registration: RegisteredDrive
    verdict: str
    reason: str
    rounds: int = 0
    pixels_before: float = math.nan
    pixels_after: float = math.nan
    rocking_sigmas: Float64Array | None = None


def refine(
    first: RegisteredDrive,
    read: Read,
    register: Callable[[Calibration], RegisteredDrive],
    in_order: InOrder,
    true_scale: Callable[[Calibration], float],
) -> SelfCalibration:
    """Refine camera and poses from the frames themselves, if they determine them.

    Parameters
    ----------
    first : RegisteredDrive
        With the calibration as it is.
    read : callable
        Returns a frame by its index; may raise FrameError.
    register : callable
        Registers all frames anew with another calibration.
    in_order : callable
        Like `map`; may work ahead.
    true_scale : callable
        By how much a camera's height is to be multiplied for what the calibration was made from to
        keep its size.
    """
    calibration = first.calibration
    if not math.isfinite(calibration.height_metres):
        return SelfCalibration(first, "not applied", "there is no calibration to refine")
    survey = survey_frames(first, read, in_order, coarse=True)
    if survey is None:
        return SelfCalibration(first, "not applied", "too few frames share floor")
    doubt = unobservable(survey.found)
    if doubt:
        return SelfCalibration(first, "not applied", doubt, 1)
    rigid = fit(calibration, survey.found.views, survey.matches, NONE, np.zeros(3))
    before = median_pixels(rigid, survey)
    why = is_confirmed(calibration, survey)
    if why:
        return _confirm(first, survey, why, before)
    current, rounds = first, 1
    while rounds < _MAX_ROUNDS and not (rounds > 1 and has_converged(survey.found)):
        current = register(with_range(calibration, survey.found.calibration))
        again = survey_frames(current, read, in_order, coarse=False)
        doubt = _doubt(first, current, again)
        if again is None or doubt:
            return SelfCalibration(first, "not applied", doubt, rounds)
        survey, rounds = again, rounds + 1
    if not explains_better(calibration, survey):
        doubt = "the refined camera explains matches that it was not made from no better"
        return SelfCalibration(first, "not applied", doubt, rounds)
    found = survey.found
    done = with_views(current, found, true_scale(found.calibration))
    reason = told(calibration, done.calibration)
    after = median_pixels(found, survey)
    return SelfCalibration(done, "refined", reason, rounds, before, after, found.rocking_sigmas)


def _confirm(
    first: RegisteredDrive, survey: BundleRound, why: str, before: float
) -> SelfCalibration:
    """Return the poses refined with the calibration as it is."""
    found = survey.found
    held = fit(first.calibration, found.views, survey.matches, NONE, found.rocking_sigmas)
    after = median_pixels(held, survey)
    done = with_views(first, held, 1.0)
    return SelfCalibration(done, "confirmed", why, 1, before, after, held.rocking_sigmas)


def _doubt(first: RegisteredDrive, current: RegisteredDrive, survey: BundleRound | None) -> str:
    """Return why frames registered anew speak against the camera; empty when they do not."""
    if _placed(current) < _placed(first):
        return f"the refined camera places {_placed(current)} frames of {_placed(first)}"
    if survey is None:
        return "with the refined camera too few frames share floor"
    return unobservable(survey.found)


def _placed(registration: RegisteredDrive) -> int:
    return sum(estimate.map_from_robot is not None for estimate in registration.estimates)
