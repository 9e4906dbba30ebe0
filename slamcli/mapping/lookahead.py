"""Lookahead: what the mapper is likely to need of a frame, computed before it is needed.

The mapper places one frame at a time; other threads have time for this. It changes no result: what
is not computed ahead is computed when it is needed.
"""

from __future__ import annotations

from slamcli.core.errors import FrameError
from slamcli.core.failures import FAILURES
from slamcli.core.records import PreparedFrame
from slamcli.registration import direct

# Where the value is needed.
_RAISED_AGAIN: tuple[type[Exception], ...] = (FrameError, *FAILURES)


def compute_ahead(prepared: PreparedFrame, *, keyframe: bool) -> None:
    """Compute what direct tracking needs of a frame. Never raises.

    Parameters
    ----------
    prepared : PreparedFrame
    keyframe : bool
        Whether it is likely to become a keyframe: so that others are tracked against it, and it is
        found again by its features.
    """
    try:
        if not keyframe and (sparse := prepared.sparse.value) is not None:
            _ = sparse.second.normalised
            return
        levels = prepared.levels[: direct.LEVELS]
        _ = [level.normalised for level in levels[-1:]]
        if keyframe and levels:
            _ = [level.points for level in levels]
            _ = prepared.repeats, prepared.features
    except _RAISED_AGAIN:
        return
