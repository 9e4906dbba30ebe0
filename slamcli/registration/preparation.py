"""Preparation of a frame for registration: all that needs no other frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from slamcli.core.deferred import Deferred
from slamcli.core.records import Features, Frame, PreparedFrame, View
from slamcli.stages import dense

LevelMasks = tuple[dense.LevelMask, ...]


def assemble(
    frame: Frame,
    views: Sequence[View],
    painting: Deferred[View],
    extraction: Deferred[Features],
    level_masks: Sequence[LevelMasks] | None = None,
) -> PreparedFrame:
    """Return a frame with its views' pyramids; its features and periods when they are needed.

    Parameters
    ----------
    frame : Frame
    views : sequence of View
        Gray, from `make_compared_views`: the near one, and the far one when the camera sees
        farther.
    painting : Deferred of View
        The gray view that features are detected in.
    extraction : Deferred of Features
        Of that view.
    level_masks : sequence or None
        From `make_level_masks` of each view's mask, where that was done before.
    """
    known: Sequence[LevelMasks | None] = level_masks or [None] * len(views)
    levels, *far = [dense.make_levels(one, mask) for one, mask in zip(views, known, strict=True)]
    return PreparedFrame(
        frame.index,
        frame.name,
        frame.stamp,
        painting,
        extraction,
        "",
        levels,
        far[0] if far else (),
        Deferred(partial(dense.find_periods, levels)),
    )
