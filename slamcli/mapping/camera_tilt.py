"""The camera's tilt as a drive shows it: which links need more of it than the others do.

A tilted camera explains nearly anything of which a view shows little: a wall or an obstacle beyond
a plain floor imitates floor seen by a camera that rocks. Links that many features support show how
much this camera does rock; what few features support may not need more than that. Where most of
them rock, a motion that a steady camera explains too is as uncertain as that rocking makes it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult, acceptance, criteria
from slamcli.registration.hypothesis import PyramidPair, score_refined
from slamcli.stages import dense

# What a drive has shown counts from this many links on, of the latest few.
_MIN_LINKS = 4
_MAX_LINKS = 20
# The median of absolute values of normal deviates is 0.67 sigmas; a tilt of more than three sigmas
# is unusual. A drive that has shown none is taken to have a third of the tilt that is expected
# beforehand [benchmarks/courses.py: right links to 0.05 degrees, wrong ones from 0.12 on].
_SIGMAS_OF_MEDIAN = 1.5
_MAX_SIGMAS = 3.0
_LEAST_SHARE = 1.0 / 3.0


def add_link(result: RegistrationResult, tracking: TrackingState, options: MapperOptions) -> None:
    """Keep the tilt of an accepted link, if many features back it or it needs none."""
    assert result.fit is not None
    if not result.fit.includes_rocking or acceptance.backed_by_features(result.alignment, options):
        tracking.tilts_radians.append(result.fit.tilt_radians)
        del tracking.tilts_radians[:-_MAX_LINKS]


def with_rocking(
    result: RegistrationResult,
    tilts_radians: list[float],
    calibration: Calibration,
    options: MapperOptions,
) -> RegistrationResult:
    """Return a link of a steady camera refined with the rocking that the drive has shown.

    Of few lines a tilt passes for a motion: the pixels suggest no rocking then, and the motion is
    millimetres off with a sigma of tenths.

    Parameters
    ----------
    result : RegistrationResult
    tilts_radians : list of float
        Of the links so far.
    calibration : Calibration
    options : MapperOptions
    """
    fit, link = result.fit, result.link
    shown = _shown_sigma(tilts_radians)
    if not is_shown(tilts_radians, options):
        return result
    if fit is None or link is None or fit.includes_rocking or criteria.mostly_obstructed(fit):
        return result
    pair = PyramidPair(result.keyframe.levels[:2], result.prepared.levels[:2])
    refined = dense.refine(pair.a, pair.b, fit.pose, calibration, shown)
    if refined is None:
        return result
    rocking = score_refined(pair, refined)
    if rocking.agreement.correlation < fit.agreement.correlation:
        return result
    link = replace(link, a_from_b=rocking.pose, covariance=rocking.covariance)
    return replace(result, link=link, fit=rocking)


def is_shown(tilts_radians: list[float], options: MapperOptions) -> bool:
    """Return whether the links so far show that the camera rocks."""
    least = _LEAST_SHARE * math.radians(options.tilt_sigma_degrees)
    return _shown_sigma(tilts_radians) > least


def _shown_sigma(tilts_radians: list[float]) -> float:
    """Return the sigma of the tilt that a drive has shown, radians; 0 while links are too few."""
    if len(tilts_radians) < _MIN_LINKS:
        return 0.0
    return _SIGMAS_OF_MEDIAN * float(np.median(tilts_radians))


def without_unusual(
    result: RegistrationResult, tilts_radians: list[float], options: MapperOptions
) -> RegistrationResult:
    """Return a result whose link or partial is left out where it needs an unusual tilt.

    Parameters
    ----------
    result : RegistrationResult
    tilts_radians : list of float
        Of the links so far.
    options : MapperOptions
    """
    fit = result.fit
    if fit is None or (result.link is None and result.partial is None):
        return result
    if acceptance.enough_inliers(result.alignment, options):
        return result
    sigma = math.radians(options.tilt_sigma_degrees)
    if len(tilts_radians) >= _MIN_LINKS:
        sigma = max(_LEAST_SHARE * sigma, _shown_sigma(tilts_radians))
    elif acceptance.backed_by_features(result.alignment, options):
        # Rocking on bare floors has 77 inliers and more, walls up to 34
        # [benchmarks/robustness.py, benchmarks/courses.py].
        return result
    if fit.tilt_radians <= _MAX_SIGMAS * sigma:
        return result
    reason = (
        f"the motion needs a camera tilted by {math.degrees(fit.tilt_radians):.1f} degrees, and "
        f"too few features support that (to {result.keyframe.name})"
    )
    return replace(result, link=None, partial=None, reason=reason)
