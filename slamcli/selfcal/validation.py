"""Whether a camera that the frames tell of is to be believed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from slamcli.core.camera.calibration import Calibration
from slamcli.selfcal.bundle import MAX_SIGMAS, NONE, BundleRound, fit
from slamcli.stages import adjustment

_HELD_OUT = 4
_SIGNIFICANCE = 0.999
# A better camera leaves less than this share of the error of matches that it was not made from;
# what is off by more than so many sigmas is no match.
_MAX_OF_BEFORE = 0.995
_CLIPPED = 5.0
# A round that moves the camera by less than this many sigmas, or this little, was the last.
_SETTLED_SIGMAS = 1.0
_SETTLED = np.array([2e-5, 2e-5, 2e-5, 2e-6, 2e-6, 2e-6, 2e-6])


def unobservable(found: adjustment.Adjustment) -> str:
    """Return which of focal length, pitch and roll the frames leave open; empty when none."""
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
        for word, sigma, most in zip(words, sigmas, MAX_SIGMAS, strict=True)
        if word and sigma > most
    ]
    if not loose:
        return ""
    return f"the frames leave open {', '.join(loose)}; drive turns, and let frames overlap more"


def is_confirmed(calibration: Calibration, survey: BundleRound) -> str:
    """Return why the calibration is as good as what was found; empty when it is not."""
    found = survey.found
    free = np.diag(found.camera_covariance) > 0.0
    change = found.camera_change[free]
    distance = float(change @ np.linalg.solve(found.camera_covariance[np.ix_(free, free)], change))
    if distance < chdtri(len(change), 1.0 - _SIGNIFICANCE):
        return "what the frames say differs from the calibration by no more than its uncertainty"
    if not explains_better(calibration, survey):
        return "another camera would explain matches that it was not made from no better"
    return ""


def explains_better(calibration: Calibration, survey: BundleRound) -> bool:
    """Return whether the camera found explains matches kept from it better than a calibration."""
    found = survey.found
    told = [_part(match, held_out=False) for match in survey.matches]
    asked = [_part(match, held_out=True) for match in survey.matches]
    errors = []
    for judged in (calibration, found.calibration):
        best = fit(judged, found.views, told, NONE, found.rocking_sigmas)
        lengths = adjustment.residual_lengths(best.calibration, best.views, asked)
        errors.append(float(np.mean(np.minimum(lengths, _CLIPPED * found.scale))))
    return errors[1] <= _MAX_OF_BEFORE * errors[0]


def has_converged(found: adjustment.Adjustment) -> bool:
    """Return whether the camera moved by no more than its uncertainty."""
    sigmas = np.sqrt(np.diag(found.camera_covariance))
    return bool(
        np.all(np.abs(found.camera_change) <= np.maximum(_SETTLED_SIGMAS * sigmas, _SETTLED))
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
