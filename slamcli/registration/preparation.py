"""Preparation of a frame for registration: all that needs no other frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from slamcli.core.arrays import Float64Array
from slamcli.core.deferred import Deferred
from slamcli.core.records import (
    NO_SPARSE_VIEW,
    Features,
    Frame,
    PreparedFrame,
    PyramidLevel,
    Pyramids,
    SparseView,
    View,
)
from slamcli.stages import dense

LevelMasks = tuple[dense.LevelMask, ...]


def make_pyramids(
    views: Sequence[View], level_masks: Sequence[LevelMasks] | None = None
) -> Pyramids:
    """Return the pyramids of a frame's views that are compared.

    Parameters
    ----------
    views : sequence of View
        Gray, from `make_compared_views`: the near one, and the far one when the camera sees
        farther.
    level_masks : sequence or None
        From `make_level_masks` of each view's mask, where that was done before.
    """
    known: Sequence[LevelMasks | None] = level_masks or [None] * len(views)
    levels, *far = [dense.make_levels(one, mask) for one, mask in zip(views, known, strict=True)]
    return Pyramids(levels, far[0] if far else ())


def assemble(
    frame: Frame,
    pyramids: Deferred[Pyramids],
    painting: Deferred[View],
    extraction: Deferred[Features],
    sparse: Deferred[SparseView | None] = NO_SPARSE_VIEW,
) -> PreparedFrame:
    """Return a frame with its pyramids, its features and its periods when they are needed.

    Parameters
    ----------
    frame : Frame
    pyramids : Deferred of Pyramids
    painting : Deferred of View
        The gray view that features are detected in.
    extraction : Deferred of Features
        Of that view.
    sparse : Deferred of SparseView or None
    """
    return PreparedFrame(
        frame.index,
        frame.name,
        frame.stamp,
        painting,
        extraction,
        "",
        pyramids,
        sparse,
        Deferred(partial(_periods, pyramids)),
        tracked=Deferred(partial(_tracked, pyramids, sparse)),
    )


def _periods(pyramids: Deferred[Pyramids]) -> Float64Array:
    return dense.find_periods(pyramids.value.near)


def _tracked(
    pyramids: Deferred[Pyramids], sparse: Deferred[SparseView | None]
) -> tuple[PyramidLevel, PyramidLevel]:
    """Return what sparse views are aligned with."""
    finest, second = pyramids.value.near[:2]
    own = sparse.value
    return finest if own is None else dense.with_detail_of(finest, own.finest), second
