"""What tracking keeps from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass, field

from slamcli.core.geometry import Pose2
from slamcli.core.records import PreparedFrame


@dataclass(slots=True, eq=False)
class TrackingState:
    """Recent keyframes and frames, and the latest motion.

    Attributes
    ----------
    keyframes : list of PreparedFrame
        The latest few, the newest last.
    latest : PreparedFrame or None
        The latest frame that could be used, placed or not.
    last_placed : PreparedFrame or None
        The latest frame with a pose.
    last_lost : PreparedFrame or None
        The latest frame, where it was lost.
    motion : Pose2 or None
        ``before_from_latest`` of the latest two frames that were placed one after the other.
    motion_frame : int
        Index of the second of these.
    """

    keyframes: list[PreparedFrame] = field(default_factory=list)
    latest: PreparedFrame | None = None
    last_placed: PreparedFrame | None = None
    last_lost: PreparedFrame | None = None
    motion: Pose2 | None = None
    motion_frame: int = 0
