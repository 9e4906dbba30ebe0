"""The motions that may explain two frames: searched for on the pixels, compared with each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.registration.hypothesis import (
    MotionHypothesis,
    PyramidPair,
    same_motion,
)
from slamcli.registration.refinement import refine_hypothesis
from slamcli.stages import dense


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Fixed numbers of the search for motions and of the comparison between them."""

    # Peaks of a search that are refined; a ridge along a line alone may have several
    # [guarded by benchmarks/robustness.py: course, textureless-course].
    max_peaks: int = 10
    # What has less than this share of the best peak's evidence on the coarsest level is no rival on
    # finer ones either [guarded by benchmarks/robustness.py: tiles].
    min_share_of_best: float = 0.4
    # Fits of the same motion with about the same evidence differ only in what else they model;
    # above this share the one with the smaller covariance is taken
    # [guarded by benchmarks/robustness.py: rocking].
    equal_evidence_share: float = 0.95
    # A motion that differs from an open one by more than this across its open direction is another
    # one [guarded by benchmarks/robustness.py: textureless-course].
    open_direction_sigmas: float = 4.0
    # Share of the patches that must prefer a motion, and how many times those that prefer its
    # rival. Two wrong motions on a worn floor are each preferred by about as many patches; where
    # all tiles are alike, noise makes a tenth of them prefer either
    # [guarded by benchmarks/robustness.py: tiles, identical-tiles].
    min_preferring_share: float = 0.15
    min_preference_ratio: float = 6.0
    # Marks that must prefer a motion, and how many times those that prefer its rival [guarded by
    # benchmarks/tiles.py: noise on tiles without marks makes up to two].
    min_marks: int = 3
    min_marks_ratio: float = 4.0
    # A rival that shares less than this share of a fit's overlap shows too little floor to be
    # compared by marks [guarded by tests/registration/test_rivals.py: squared paper].
    min_compared_share: float = 0.5
    # The few pixels of the coarsest level correlate by chance: its correlation counts less this
    # [guarded by benchmarks/robustness.py: noise on bare].
    coarse_handicap: float = 0.2


SETTINGS = SearchSettings()


def search(
    pair: PyramidPair, window: dense.SearchWindow, calibration: Calibration, options: MapperOptions
) -> tuple[dense.Search, list[MotionHypothesis]]:
    """Search a window for motions; return the search, and its peaks refined on all levels."""
    found = dense.search(
        pair.a[-1],
        pair.b[-1],
        window,
        min_overlap=options.min_overlap,
        count=SETTINGS.max_peaks,
    )
    # A start from which the refinement runs away is a slope of the evidence, no peak.
    refined_fits = [
        refine_hypothesis(pair, start, None, calibration, options)
        for start in _best_peaks(pair, found, calibration, options)
    ]
    return found, [fit for fit in refined_fits if fit is not None]


def _best_peaks(
    pair: PyramidPair, found: dense.Search, calibration: Calibration, options: MapperOptions
) -> list[Pose2]:
    """Refine a search's peaks on its own level; return those that may be the best or its rival."""
    tilt = math.radians(options.tilt_sigma_degrees)
    coarse_a, coarse_b = pair.a[-1:], pair.b[-1:]
    assumptions = dense.RefinementAssumptions(from_search=True)
    peaks: list[dense.Candidate] = []
    for peak in found.candidates:
        if peak.evidence < SETTINGS.min_share_of_best * found.candidates[0].evidence:
            continue
        refined = dense.refine(coarse_a, coarse_b, peak.a_from_b, calibration, tilt, assumptions)
        pose, view_a_from_view_b = peak.a_from_b, peak.a_from_b.matrix
        if refined is not None:
            pose, view_a_from_view_b = refined.a_from_b, refined.view_a_from_view_b
        if not any(same_motion(other.a_from_b, pose, pair) for other in peaks):
            peaks.append(dense.evidence(coarse_a[0], coarse_b[0], pose, view_a_from_view_b))
    peaks.sort(key=lambda peak: -peak.evidence)
    kept = [p for p in peaks if p.evidence >= SETTINGS.min_share_of_best * peaks[0].evidence]
    return [peak.a_from_b for peak in kept[: options.max_hypotheses]]


def outside_open_direction(
    fits: Sequence[MotionHypothesis], best: MotionHypothesis
) -> list[MotionHypothesis]:
    """Leave out what differs from the best only along its least certain direction.

    That direction is known as well as the heading is.
    """
    variances, directions = np.linalg.eigh(best.predicted_covariance[:2, :2])
    turn_sigma = math.sqrt(float(best.predicted_covariance[2, 2]))
    kept = []
    for fit in fits:
        apart = best.pose.inverse() @ fit.pose
        across, along = np.abs(directions.T @ (apart.x, apart.y))
        sigma = math.hypot(math.sqrt(float(variances[0])), turn_sigma * float(along))
        if (
            max(float(across) / sigma, abs(apart.theta) / turn_sigma)
            > SETTINGS.open_direction_sigmas
        ):
            kept.append(fit)
    return kept


def preferred_by_patches(pair: PyramidPair, fit: MotionHypothesis, rival: MotionHypothesis) -> bool:
    """Return whether many patches prefer a motion to its rival, and few the rival."""
    pro, contra = dense.patch_votes(
        pair.a[1], pair.b[1], fit.view_a_from_view_b, rival.view_a_from_view_b
    )
    return pro >= SETTINGS.min_preferring_share and contra <= pro / SETTINGS.min_preference_ratio


def preferred_by_marks(pair: PyramidPair, fit: MotionHypothesis, rival: MotionHypothesis) -> bool:
    """Return whether several marks on the floor prefer a motion to its rival, and few the rival."""
    pro, contra = dense.distinguishing_marks(
        pair.a[0], pair.b[0], fit.view_a_from_view_b, rival.view_a_from_view_b
    )
    return pro >= SETTINGS.min_marks and contra <= pro / SETTINGS.min_marks_ratio


def preferred(pair: PyramidPair, fit: MotionHypothesis, rival: MotionHypothesis) -> bool:
    """Return whether the pixels rule a rival out beside a motion, by many patches or by marks."""
    return preferred_by_patches(pair, fit, rival) or preferred_by_marks(pair, fit, rival)


def coarse_similarity(pair: PyramidPair, fit: MotionHypothesis) -> float:
    """Return the views' correlation where noise does not lower it: on the coarsest level too."""
    coarse = dense.evidence(pair.a[-1], pair.b[-1], fit.pose, fit.view_a_from_view_b).correlation
    return max(fit.correlation, coarse - SETTINGS.coarse_handicap)


def without_duplicates(
    fits: Sequence[MotionHypothesis], pair: PyramidPair
) -> list[MotionHypothesis]:
    """Return the motions, best first, each once: of equal ones the most certain."""
    kept: list[MotionHypothesis] = []
    for fit in sorted(fits, key=lambda fit: -fit.evidence):
        index = next(
            (n for n, other in enumerate(kept) if same_motion(other.pose, fit.pose, pair)), None
        )
        if index is None:
            kept.append(fit)
            continue
        equal = fit.evidence > SETTINGS.equal_evidence_share * kept[index].evidence
        if equal and _more_certain(fit, kept[index]):
            kept[index] = fit
    return kept


def _more_certain(fit: MotionHypothesis, other: MotionHypothesis) -> bool:
    return bool(np.linalg.det(fit.predicted_covariance) < np.linalg.det(other.predicted_covariance))
