"""Why a frame is in no map of a survey, and what may help."""

from __future__ import annotations

from collections.abc import Sequence

from slamcli.io.frames import FrameFile
from slamcli.survey import Survey, SurveyFeatures

# Fewer points than this cannot be matched.
_MIN_TEXTURE = 14


def lost_reason(
    number: int, found: Survey, files: Sequence[FrameFile], features: SurveyFeatures | None
) -> str:
    """Return why a frame is in no map, and what may help."""
    points = 0 if features is None else len(features)
    if points < _MIN_TEXTURE:
        return (
            f"too little texture, or blurred ({points} distinct points): more light, a shorter "
            "exposure or a lower camera may help"
        )
    own = [pair for pair in found.contradicted if number in (pair.a, pair.b)]
    if own:
        other = files[own[0].a + own[0].b - number].name
        return f"its match with {other} contradicts the others; more overlap decides"
    own = [pair for pair in found.rejected if number in (pair.a, pair.b)]
    if not own:
        return "shares no texture with any other frame; frames should overlap by a third"
    best = max(own, key=lambda pair: (pair.inliers, -pair.a, -pair.b))
    other = files[best.a + best.b - number].name
    return (
        f"overlaps no other frame enough; frames should overlap by a third "
        f"(nearest {other}: {best.reason})"
    )
