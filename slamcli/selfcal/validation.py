"""Validation of an adjusted camera: observability, significance, and error of held-out matches."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from slamcli.core.camera.calibration import Calibration
from slamcli.selfcal.bundle import MAX_SIGMAS, NONE, BundleRound, fit
from slamcli.stages import adjustment

# Every this many-th match is held out of the fit.
# [All thresholds here are guarded by benchmarks/self_calibration.py.]
_HELD_OUT = 4
_SIGNIFICANCE = 0.999
# A better camera leaves at most this share of the error of held-out matches, each clipped at this
# many sigmas, beyond which it is an outlier.
_MAX_ERROR_SHARE = 0.995
_CLIPPED_SIGMAS = 5.0
# Rounds have converged when the camera changes by less than this many sigmas, or this little.
_CONVERGED_SIGMAS = 1.0
_CONVERGED = np.array([2e-5, 2e-5, 2e-5, 2e-6, 2e-6, 2e-6, 2e-6])


def unobservable(found: adjustment.Adjustment) -> str:
    """Return which of focal length, pitch and roll the frames do not determine; empty when none."""
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    words = (
        f"the focal length (±{sigmas[0]:.1%})",
        "",
        "",
        f"the pitch (±{math.degrees(sigmas[3]):.2g}°)",
        f"the roll (±{math.degrees(sigmas[4]):.2g}°)",
        "",
        "",
    )
    loose = [
        word
        for word, sigma, limit in zip(words, sigmas, MAX_SIGMAS, strict=True)
        if word and sigma > limit
    ]
    if not loose:
        return ""
    return (
        f"the frames do not determine {', '.join(loose)}; drive turns, and let frames overlap more"
    )


def is_confirmed(calibration: Calibration, bundle: BundleRound) -> str:
    """Return why the calibration is as good as the adjusted camera; empty when it is not.

    Either they do not differ significantly (chi-squared test of the change), or the adjusted camera
    does not generalise to held-out matches.
    """
    found = bundle.found
    free = np.diag(found.camera_covariance) > 0.0
    change = found.camera_change[free]
    distance = float(change @ np.linalg.solve(found.camera_covariance[np.ix_(free, free)], change))
    if distance < chdtri(len(change), 1.0 - _SIGNIFICANCE):
        return "the adjusted camera differs from the calibration by no more than its uncertainty"
    if not explains_better(calibration, bundle):
        return "the adjusted camera explains held-out matches no better than the calibration"
    return ""


def explains_better(calibration: Calibration, bundle: BundleRound) -> bool:
    """Return whether the adjusted camera explains held-out matches better than a calibration.

    Poses and rocking are fitted to the other matches, with either camera fixed.
    """
    found = bundle.found
    fitted = [_part(match, held_out=False) for match in bundle.matches]
    held_out = [_part(match, held_out=True) for match in bundle.matches]
    errors = []
    for camera in (calibration, found.calibration):
        best = fit(camera, found.poses, fitted, NONE, found.rocking_sigmas)
        lengths = adjustment.residual_lengths(best.calibration, best.poses, held_out)
        errors.append(float(np.mean(np.minimum(lengths, _CLIPPED_SIGMAS * found.scale))))
    return errors[1] <= _MAX_ERROR_SHARE * errors[0]


def has_converged(found: adjustment.Adjustment) -> bool:
    """Return whether the round changed the camera by no more than its uncertainty."""
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    return bool(
        np.all(np.abs(found.camera_change) <= np.maximum(_CONVERGED_SIGMAS * sigmas, _CONVERGED))
    )


def _part(match: adjustment.Matches, *, held_out: bool) -> adjustment.Matches:
    """Return every fourth of a pair's matches, or the others."""
    chosen = (np.arange(len(match)) % _HELD_OUT == 0) == held_out
    return replace(
        match,
        pixels_a=match.pixels_a[chosen],
        pixels_b=match.pixels_b[chosen],
        whitening=match.whitening[chosen],
    )
