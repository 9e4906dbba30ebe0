"""What tracking keeps from frame to frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from slamcli.core.geometry import Pose2
from slamcli.core.records import PreparedFrame
from slamcli.mapping.saved_state import TrackingFrames


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
    prediction_errors : list of (float, float)
        By how much the latest motions differed from the ones before: metres, radians.
    revisited : set of int
        Those of the keyframes that show floor which is seen again, taken from storage.
    tilts_radians : list of float
        The camera's tilt, off the calibration's, in the latest links that many features support or
        that need none.
    """

    keyframes: list[PreparedFrame] = field(default_factory=list)
    latest: PreparedFrame | None = None
    last_placed: PreparedFrame | None = None
    last_lost: PreparedFrame | None = None
    motion: Pose2 | None = None
    motion_frame: int = 0
    prediction_errors: list[tuple[float, float]] = field(default_factory=list)
    revisited: set[int] = field(default_factory=set)
    tilts_radians: list[float] = field(default_factory=list)

    @property
    def is_revisiting(self) -> bool:
        """Whether frames are tracked by a keyframe of floor that is seen again."""
        return any(one.index in self.revisited for one in self.keyframes[-1:])

    def add_keyframe(self, keyframe: PreparedFrame, limit: int, *, revisited: bool = False) -> None:
        """Make a keyframe the newest, and leave out those before the latest few.

        Parameters
        ----------
        keyframe : PreparedFrame
        limit : int
            How many are kept.
        revisited : bool
            Whether it shows floor that is seen again.
        """
        others = [one for one in self.keyframes if one.index != keyframe.index]
        self.keyframes = [*others, keyframe][-limit:]
        if revisited:
            self.revisited.add(keyframe.index)
        self.revisited &= {one.index for one in self.keyframes}

    def forget_lost(self, is_placed: Callable[[int], bool]) -> None:
        """Leave out the keyframes that are lost by now, and with them what followed from them."""
        self.keyframes = [one for one in self.keyframes if is_placed(one.index)]
        if self.last_placed is not None and not is_placed(self.last_placed.index):
            self.last_placed = self.motion = None

    def frames(self) -> TrackingFrames:
        """Return the state with frames by their indices, as `restore` needs it."""
        return TrackingFrames(
            tuple(keyframe.index for keyframe in self.keyframes),
            None if self.latest is None else self.latest.index,
            None if self.last_placed is None else self.last_placed.index,
            None if self.last_lost is None else self.last_lost.index,
            self.motion,
            self.motion_frame,
            list(self.prediction_errors),
            tuple(sorted(self.revisited)),
            list(self.tilts_radians),
        )

    def restore(self, saved: TrackingFrames, prepared: Mapping[int, PreparedFrame]) -> None:
        """Take over a saved state, with its frames prepared or decoded again, each once."""

        def of(index: int | None) -> PreparedFrame | None:
            return None if index is None else prepared[index]

        self.keyframes = [prepared[index] for index in saved.keyframes]
        self.latest, self.last_placed = of(saved.latest), of(saved.last_placed)
        self.last_lost = of(saved.last_lost)
        self.motion, self.motion_frame = saved.motion, saved.motion_frame
        self.prediction_errors = list(saved.prediction_errors)
        self.revisited = set(saved.revisited)
        self.tilts_radians = list(saved.tilts_radians)
