"""Motions that may explain two frames: found on the pixels and weighed against one another."""

from __future__ import annotations

import math

import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.registration import refinement
from slamcli.registration.refinement import MotionHypothesis, PyramidPair
from slamcli.stages import dense

# So many peaks of a search are followed up; a ridge along a line alone may hold several.
_PEAKS = 10
# What explains less than this share of what the best peak does, on the coarsest level, is no rival
# on finer ones either.
_MIN_SHARE_OF_BEST = 0.4
# Fits of one motion with about the same evidence differ in what they let the camera do besides.
_EQUAL_SHARE = 0.95
_OPEN_SIGMAS = 4.0
# Of the patches, for a motion; so many times those for its rival. Two wrong motions on a worn floor
# each have about as many for them; on one whose tiles are all alike noise speaks for a tenth.
_MIN_PREFERENCE, _PREFERENCE_TIMES = 0.15, 6.0
# By so much more must views be alike on the coarsest level, whose few pixels agree by chance.
_COARSE_HANDICAP = 0.2


def search(
    pair: PyramidPair, window: dense.SearchWindow, calibration: Calibration, options: MapperOptions
) -> tuple[dense.Search, list[MotionHypothesis]]:
    """Search every motion of a window; return what was found, and what holds on all levels."""
    found = dense.search(
        pair.a[-1], pair.b[-1], window, min_overlap=options.min_overlap, count=_PEAKS
    )
    # A start that the refinement leaves far behind is a slope of the evidence, not a peak.
    refined_fits = [
        refinement.refine_hypothesis(pair, start, None, calibration, options)
        for start in _follow_up(pair, found, calibration, options)
    ]
    return found, [fit for fit in refined_fits if fit is not None]


def _follow_up(
    pair: PyramidPair, found: dense.Search, calibration: Calibration, options: MapperOptions
) -> list[Pose2]:
    """Refine a search's peaks on its own level; return those that may be the best or its rival."""
    tilt = math.radians(options.tilt_sigma_degrees)
    coarse_a, coarse_b = pair.a[-1:], pair.b[-1:]
    peaks: list[dense.Candidate] = []
    for peak in found.candidates:
        if peak.evidence < _MIN_SHARE_OF_BEST * found.candidates[0].evidence:
            continue
        refined = dense.refine(coarse_a, coarse_b, peak.a_from_b, calibration, tilt, searched=True)
        pose, shown = peak.a_from_b, peak.a_from_b.matrix
        if refined is not None:
            pose, shown = refined.a_from_b, refined.view_a_from_view_b
        if not any(refinement.same(other.a_from_b, pose, pair) for other in peaks):
            peaks.append(dense.evidence(coarse_a[0], coarse_b[0], pose, shown))
    peaks.sort(key=lambda peak: -peak.evidence)
    kept = [p for p in peaks if p.evidence >= _MIN_SHARE_OF_BEST * peaks[0].evidence]
    return [peak.a_from_b for peak in kept[: options.max_hypotheses]]


def periodic_alternatives(
    pair: PyramidPair,
    fit: MotionHypothesis,
    repeats: Float64Array,
    calibration: Calibration,
    options: MapperOptions,
) -> list[MotionHypothesis]:
    """Return the motions that a floor which repeats makes look like a fit, each as it fits best."""
    found = []
    for x, y in (*repeats, *-repeats):
        start = fit.pose @ Pose2(float(x), float(y))
        refined = dense.refine(pair.a[:2], pair.b[:2], start, calibration, 0.0)
        if refined is not None and not refinement.same(refined.a_from_b, fit.pose, pair):
            found.append(refinement.score_refined(pair, refined))
    return [rival for rival in found if rival.agreed.overlap >= options.min_overlap]


def outside_open_direction(
    fits: list[MotionHypothesis], best: MotionHypothesis
) -> list[MotionHypothesis]:
    """Leave out what differs from the best only where it is known least, as along a line."""
    variances, directions = np.linalg.eigh(best.covariance[:2, :2])
    max_across = _OPEN_SIGMAS * math.sqrt(float(variances[0]))
    max_turn = _OPEN_SIGMAS * math.sqrt(float(best.covariance[2, 2]))
    kept = []
    for fit in fits:
        apart = best.pose.inverse() @ fit.pose
        across = abs(float(directions[:, 0] @ (apart.x, apart.y)))
        if across > max_across or abs(apart.theta) > max_turn:
            kept.append(fit)
    return kept


def preferred_by_patches(pair: PyramidPair, fit: MotionHypothesis, rival: MotionHypothesis) -> bool:
    """Return whether many patches speak for a motion, and few for its rival."""
    pro, contra = dense.patch_votes(
        pair.a[1], pair.b[1], fit.view_a_from_view_b, rival.view_a_from_view_b
    )
    return pro >= _MIN_PREFERENCE and contra <= pro / _PREFERENCE_TIMES


def coarse_similarity(pair: PyramidPair, fit: MotionHypothesis) -> float:
    """Return how like the views are: on a bare floor the camera's noise hides it but coarsely."""
    coarse = dense.evidence(pair.a[-1], pair.b[-1], fit.pose, fit.view_a_from_view_b).correlation
    return max(fit.correlation, coarse - _COARSE_HANDICAP)


def without_duplicates(fits: list[MotionHypothesis], pair: PyramidPair) -> list[MotionHypothesis]:
    """Return the motions, best first, each once: as it is known best among equals."""
    kept: list[MotionHypothesis] = []
    for fit in sorted(fits, key=lambda fit: -fit.evidence):
        place = next(
            (n for n, k in enumerate(kept) if refinement.same(k.pose, fit.pose, pair)), None
        )
        if place is None:
            kept.append(fit)
        elif fit.evidence > _EQUAL_SHARE * kept[place].evidence and _surer(fit, kept[place]):
            kept[place] = fit
    return kept


def _surer(fit: MotionHypothesis, other: MotionHypothesis) -> bool:
    return bool(np.linalg.det(fit.covariance) < np.linalg.det(other.covariance))
