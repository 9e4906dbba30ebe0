"""The camera's tilt as a drive shows it: which links need more of it than the others do.

A tilted camera explains nearly anything of which a view shows little: a wall or an obstacle beyond
a plain floor imitates floor seen by a camera that rocks. Links that many features support show how
much this camera does rock; what few features support may not need more than that.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.config import MapperOptions
from slamcli.mapping.tracking_state import TrackingState
from slamcli.registration import RegistrationResult, acceptance

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
        shown = _SIGMAS_OF_MEDIAN * float(np.median(tilts_radians))
        sigma = max(_LEAST_SHARE * sigma, shown)
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
