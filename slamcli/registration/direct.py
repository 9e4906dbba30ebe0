"""Direct tracking: the motion to a keyframe by pixels alone, from where it is expected.

Between keyframes the pixels of the latest one explain nearly all of a frame. Its motion is then
refined on them from the expected one (a direct method: Irani and Anandan, All about direct methods,
1999), and needs no features. It is accepted only where nothing is left to explain: otherwise
the frame is registered by its features, as if it had not been tried.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.geometry import Pose2
from slamcli.core.records import NO_PERIODS, FeatureAlignment, PreparedFrame, SparseView
from slamcli.registration import acceptance, criteria, rivals
from slamcli.registration.hypothesis import (
    MotionHypothesis,
    PyramidPair,
    score_agreement,
    score_coarsely,
    score_finely,
    with_evidence,
)
from slamcli.registration.result import ACCEPTED, RegistrationResult
from slamcli.registration.selection import PairContext
from slamcli.stages import dense

# From frame to frame the motion model is off by less than a pixel or two.
LEVELS = 2
# Share of the overlap's informative patches that must agree [guarded by benchmarks/robustness.py].
_MIN_CONFIRMED = 0.7
# A narrow strip fits nearly anything [guarded by benchmarks/robustness.py].
_MIN_OVERLAP = 0.3
# What repeats in the floor that both see repeats in the keyframe too, where that is most of it
# [guarded by benchmarks/tiles.py: 0 false links; a keyframe takes 6 ms less,
# benchmarks/streaming.py].
MIN_OVERLAP_OF_PERIODS = 0.6
# Sigma of a motion in its least certain direction, as a share of the camera's range: 0.0001 to
# 0.0004 where the floor fixes it. Along a plain line noise passes for some information now and
# then, and no search shows that other motions fit as well
# [guarded by tests/mapping/test_direct_tracking.py].
_MAX_SIGMA_SHARE = 0.001
_NO_ALIGNMENT = FeatureAlignment(
    "rigid",
    None,
    None,
    None,
    np.empty((0, 2), np.int32),
    np.empty(0, np.bool_),
    np.empty(0),
    0.0,
)


def track(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    start: Pose2,
    calibration: Calibration,
    options: MapperOptions,
    prior: dense.MotionPrior,
    levels: int = LEVELS,
) -> RegistrationResult | None:
    """Return a frame's motion from a keyframe, refined on the pixels of both.

    Parameters
    ----------
    keyframe, prepared : PreparedFrame
    start : Pose2
        ``keyframe_from_prepared`` as expected.
    calibration : Calibration
    options : MapperOptions
    prior : MotionPrior
        What odometry or the motion model say of the motion; a surprising motion is not accepted.
    levels : int
        The finest levels of the pyramids that are used; the more, the farther the start may be off.

    Returns
    -------
    RegistrationResult or None
        With a link; None where the pixels do not prove a motion.
    """
    pair = PyramidPair(keyframe.levels, prepared.levels)
    refined = dense.refine(
        pair.a[:levels], pair.b[:levels], start, calibration, 0.0, _steady(options)
    )
    if refined is None or not rivals.is_expected(prior, refined.a_from_b):
        return None
    fit = score_coarsely(pair, refined)
    context = _context(keyframe, prepared, calibration, options, prior, fit)
    if not _explains_all(context, fit):
        return None
    if context.suggested(fit):
        fit = score_finely(pair, fit)
        if context.check_rivals(pair, fit):
            return None
    return _accepted(context, prepared, fit)


def track_sparsely(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    sparse: SparseView,
    calibration: Calibration,
    options: MapperOptions,
    prior: dense.MotionPrior,
) -> RegistrationResult | None:
    """Return the motion of a frame that shows little new, by its sparse view alone.

    As by `track`, but that its pixels are compared with the keyframe's on the second level. Where
    that is not enough for certain, because other motions may fit as well or because the frame may
    become a keyframe, there is no result.

    Parameters
    ----------
    keyframe, prepared : PreparedFrame
    sparse : SparseView
        Of the frame.
    calibration : Calibration
    options : MapperOptions
    prior : MotionPrior

    Returns
    -------
    RegistrationResult or None
        With a link.
    """
    if keyframe.tracked is None:
        return None
    levels, tracked = (sparse.finest, sparse.second), keyframe.tracked.value
    refined = dense.refine(tracked, levels, prior.a_from_b, calibration, 0.0, _steady(options))
    if refined is None or not rivals.is_expected(prior, refined.a_from_b):
        return None
    fit = score_agreement(keyframe.levels[1], sparse.second, refined)
    if fit.agreement.overlap < max(options.keyframe_overlap, MIN_OVERLAP_OF_PERIODS):
        return None
    # Gray values that agree so well need no evidence of normalised contrast beside them.
    if not criteria.explained_by_steady_camera(fit):
        fit = with_evidence(fit, keyframe.levels[1], sparse.second)
    context = _context(keyframe, prepared, calibration, options, prior, fit)
    if not _explains_all(context, fit) or context.suggested(fit):
        return None
    return _accepted(context, prepared, fit)


def _steady(options: MapperOptions) -> dense.RefinementAssumptions:
    """Return that the camera is steady, unless the residuals suggest that it rocked."""
    return dense.RefinementAssumptions(
        suspected_tilt_radians=math.radians(options.tilt_sigma_degrees)
    )


def _context(
    keyframe: PreparedFrame,
    prepared: PreparedFrame,
    calibration: Calibration,
    options: MapperOptions,
    prior: dense.MotionPrior,
    fit: MotionHypothesis,
) -> PairContext:
    """Return two frames without features; the periods are the keyframe's where it shows them."""
    if fit.agreement.overlap >= MIN_OVERLAP_OF_PERIODS:
        prepared = replace(prepared, periodicity=NO_PERIODS)
    return PairContext(keyframe, prepared, _NO_ALIGNMENT, calibration, options, 0.0, prior)


def _accepted(
    context: PairContext, prepared: PreparedFrame, fit: MotionHypothesis
) -> RegistrationResult | None:
    """Return the result of an accepted motion; None where its score is too low for a link."""
    result = context.result(fit, ACCEPTED)
    return None if result.link is None else replace(result, prepared=prepared)


def _explains_all(context: PairContext, fit: MotionHypothesis) -> bool:
    """Return whether a motion is determined, plausible, and leaves nothing to explain."""
    options, range_metres = context.options, context.calibration.max_range_metres
    return (
        fit.agreement.overlap >= _MIN_OVERLAP
        and fit.agreement.confirmed >= _MIN_CONFIRMED
        and criteria.explains_all(fit)
        and not acceptance.check_observable(
            fit, range_metres, replace(options, max_sigma_share=_MAX_SIGMA_SHARE)
        )
        and not acceptance.check_plausible(fit, context.max_displacement_metres, options)
    )
