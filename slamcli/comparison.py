"""One frame against one keyframe: what fits, and whether the pixels let it be believed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from slamcli.core.records import Link
from slamcli.stages import align, dense

if TYPE_CHECKING:
    from slamcli.core.config import MapperOptions
    from slamcli.core.geometry import Pose2
    from slamcli.core.records import Alignment, Calibration, Prepared

# How far from a guess matches are looked for, as a share of how far the camera sees.
_SEARCH_SHARE_OF_RANGE = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One comparison of a frame with a keyframe: what fits, or why nothing does.

    Attributes
    ----------
    keyframe, prepared : Prepared
    alignment : Alignment
        What the features said.
    link : Link or None
    overlap : float
        Share of the smaller view's floor that both see; 0 when the features gave no fit.
    reason : str
        Why there is no link; empty when there is one.
    """

    keyframe: Prepared
    prepared: Prepared
    alignment: Alignment
    link: Link | None
    overlap: float = 0.0
    reason: str = ""


def compare(
    keyframe: Prepared,
    prepared: Prepared,
    guess: Pose2 | None,
    calibration: Calibration,
    options: MapperOptions,
) -> Trial:
    """Align a frame to a keyframe and check the fit by the pixels before it is believed.

    Parameters
    ----------
    keyframe, prepared : Prepared
        Both with features and levels.
    guess : Pose2 or None
        ``keyframe_from_prepared`` as expected; matches are looked for near it alone.
    """
    assert keyframe.features is not None
    assert prepared.features is not None
    matching = replace(
        options.matching,
        model="rigid",
        search_radius=_SEARCH_SHARE_OF_RANGE * calibration.max_range_metres,
    )
    fit = align.align(keyframe.features, prepared.features, matching, guess)
    if fit.pose is None or fit.covariance is None or fit.reason:
        return Trial(keyframe, prepared, fit, None, 0.0, f"{fit.reason} (to {keyframe.name})")
    pose, covariance = fit.pose, fit.covariance
    finest = keyframe.levels[0], prepared.levels[0]
    agreed = dense.agreement(*finest, pose)
    if options.refine:
        tilt = math.radians(options.tilt_sigma_degrees)
        refined = dense.refine(keyframe.levels, prepared.levels, pose, calibration, tilt)
        if refined is not None:
            again = dense.agreement(*finest, refined.a_from_b)
            if again.correlation > agreed.correlation:
                pose, covariance, agreed = refined.a_from_b, refined.covariance, again
    doubt = _doubt(pose, agreed, options)
    if doubt:
        reason = f"{doubt} (to {keyframe.name})"
        return Trial(keyframe, prepared, fit, None, agreed.overlap, reason)
    link = Link(
        keyframe.index,
        prepared.index,
        pose,
        covariance,
        fit.inlier_count,
        agreed.correlation,
        "step",
    )
    return Trial(keyframe, prepared, fit, link, agreed.overlap)


def _doubt(pose: Pose2, agreed: dense.Agreement, options: MapperOptions) -> str:
    """Return why a fit is not plausible, or contradicted by the pixels; empty when neither."""
    turn = abs(math.degrees(pose.theta))
    if turn > options.max_turn_degrees:
        return (
            f"the fit turns the robot by {turn:.0f} degrees; "
            f"at most {options.max_turn_degrees:.0f} are plausible"
        )
    if agreed.overlap < options.min_overlap:
        return (
            f"the fit leaves an overlap of {agreed.overlap:.0%}; "
            f"at least {options.min_overlap:.0%} is needed"
        )
    if not agreed.correlation >= options.min_score:
        return (
            f"the pixels disagree with the fit: correlation {agreed.correlation:.2f}; "
            f"at least {options.min_score:.2f} is needed"
        )
    return ""
