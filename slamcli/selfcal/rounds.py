"""Rounds of self-calibration: registration and bundle adjustment in turn, until convergence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.selfcal.apply import apply_adjustment, describe_change, with_range
from slamcli.selfcal.bundle import (
    BRIEF,
    NONE,
    THOROUGH,
    BundleRound,
    Effort,
    InOrder,
    RegisteredDrive,
    adjust_drive,
    fit,
    median_pixels,
)
from slamcli.selfcal.correspondences import Read
from slamcli.selfcal.validation import explains_better, has_converged, is_confirmed, unobservable
from slamcli.stages import adjustment

Verdict = Literal["refined", "confirmed", "not applied"]


@dataclass(frozen=True, slots=True, eq=False)
class SelfCalibration:
    """Result of a self-calibration.

    Attributes
    ----------
    registration : RegisteredDrive
        With refined camera and poses where they are accepted, else as it was given.
    verdict : str
        ``refined``, ``confirmed`` (the calibration is right; poses refined), or ``not applied``.
    reason : str
        In words.
    rounds : int
    pixels_before, pixels_after : float
        Median reprojection error of spots known in both directions; with the calibration's camera
        and without rocking, and as refined. Nan when not measured.
    rocking_sigmas : (3,) float64
        By how much pitch, roll (rad) and height (as a share) vary from frame to frame.
    """

    registration: RegisteredDrive
    verdict: Verdict
    reason: str
    rounds: int = 0
    pixels_before: float = math.nan
    pixels_after: float = math.nan
    rocking_sigmas: Float64Array | None = None


def refine_calibration(
    first: RegisteredDrive,
    read: Read,
    register: Callable[[Calibration], RegisteredDrive],
    in_order: InOrder,
    true_scale: Callable[[adjustment.Adjustment], float],
    effort: Effort = THOROUGH,
) -> SelfCalibration:
    """Refine camera and poses from the frames themselves, if the frames determine them.

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
        Returns the factor of the adjusted camera's height that keeps the size of what the
        calibration was made from.
    effort : Effort
    """
    calibration = first.calibration
    if not math.isfinite(calibration.height_metres):
        return SelfCalibration(first, "not applied", "there is no calibration to refine")
    bundle = adjust_drive(first, read, in_order, effort)
    if bundle is None:
        return SelfCalibration(first, "not applied", "too few frames share floor")
    rejection = unobservable(bundle.found)
    if rejection:
        return SelfCalibration(first, "not applied", rejection, 1)
    rigid = fit(calibration, bundle.found.poses, bundle.matches, NONE, np.zeros(3))
    before = median_pixels(rigid, bundle.matches)
    reason = is_confirmed(calibration, bundle)
    if reason:
        return _confirm(first, bundle, reason, before)
    current, rounds = first, 1
    max_rounds = 1 if effort is BRIEF and _is_whole(first) else effort.rounds
    while rounds < max_rounds and not (rounds > 1 and has_converged(bundle.found)):
        current = _located_anew(first, current, bundle, register)
        following = adjust_drive(current, read, in_order, effort, bundle.found)
        rejection = _rejection(first, current, following)
        if following is None or rejection:
            return SelfCalibration(first, "not applied", rejection, rounds)
        bundle, rounds = following, rounds + 1
    if not explains_better(calibration, bundle):
        rejection = "the refined camera explains held-out matches no better than the calibration"
        return SelfCalibration(first, "not applied", rejection, rounds)
    found = bundle.found
    done = apply_adjustment(current, found, true_scale(found))
    reason = describe_change(calibration, done.calibration)
    after = median_pixels(found, bundle.matches)
    return SelfCalibration(done, "refined", reason, rounds, before, after, found.rocking_sigmas)


def _located_anew(
    first: RegisteredDrive,
    current: RegisteredDrive,
    bundle: BundleRound,
    register: Callable[[Calibration], RegisteredDrive],
) -> RegisteredDrive:
    """Return the drive with the adjusted camera, from which the next round predicts its matches.

    Where all frames are placed in one map and each is matched, their adjusted poses predict them as
    well as a registration does, which costs as much as all else.
    """
    if _is_whole(first) and len(bundle.found.poses) == len(first.estimates):
        return apply_adjustment(current, bundle.found, 1.0)
    return register(with_range(first.calibration, bundle.found.calibration))


def _confirm(
    first: RegisteredDrive, bundle: BundleRound, reason: str, before: float
) -> SelfCalibration:
    """Return the poses refined with the calibration as it is."""
    found = bundle.found
    fixed = fit(first.calibration, found.poses, bundle.matches, NONE, found.rocking_sigmas)
    after = median_pixels(fixed, bundle.matches)
    done = apply_adjustment(first, fixed, 1.0)
    return SelfCalibration(done, "confirmed", reason, 1, before, after, fixed.rocking_sigmas)


def _rejection(first: RegisteredDrive, current: RegisteredDrive, bundle: BundleRound | None) -> str:
    """Return why frames registered anew are evidence against the camera; empty when not."""
    placed = _placed(current)
    if bundle is not None and _is_whole(current):
        # A camera with which a frame no longer matches any other cannot place it.
        placed = min(placed, len(bundle.found.poses))
    if placed < _placed(first):
        return f"the refined camera places {placed} frames of {_placed(first)}"
    if bundle is None:
        return "with the refined camera too few frames share floor"
    return unobservable(bundle.found)


def _is_whole(drive: RegisteredDrive) -> bool:
    """Return whether all frames are placed in one map."""
    return {estimate.fragment for estimate in drive.estimates} == {0} and _placed(drive) == len(
        drive.estimates
    )


def _placed(drive: RegisteredDrive) -> int:
    return sum(estimate.map_from_robot is not None for estimate in drive.estimates)
