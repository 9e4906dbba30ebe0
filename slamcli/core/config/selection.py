"""Options that select frames from files with many: videos, bags."""

from __future__ import annotations

from dataclasses import dataclass

from slamcli.core.errors import InputError

# Consecutive frames of a robot, a drone or a phone still overlap at ten a second, and more add
# time, not accuracy.
_DEFAULT_SECONDS = 0.1


@dataclass(frozen=True, slots=True)
class FrameSelection:
    """Which frames of a video or a bag are used.

    Attributes
    ----------
    every_seconds : float or None
        One frame, the sharpest, is taken from each interval of this length.
    frames_per_second : float or None
        The same as a rate.
    from_seconds, to_seconds : float or None
        The part that is read, from the first frame on.
    topic : str
        Of the frames of a bag; empty for the only one.
    """

    every_seconds: float | None = None
    frames_per_second: float | None = None
    from_seconds: float | None = None
    to_seconds: float | None = None
    topic: str = ""

    def __post_init__(self) -> None:
        if self.every_seconds is not None and self.frames_per_second is not None:
            raise InputError("give one of --every and --fps: both set the time between two frames")
        if self.to_seconds is not None and self.to_seconds <= (self.from_seconds or 0.0):
            raise InputError(f"--to {self.to_seconds:g} is not after --from: no frame is left")

    @property
    def interval_seconds(self) -> float:
        """Length of the interval that gives one frame."""
        if self.frames_per_second is not None:
            return 1.0 / self.frames_per_second
        return _DEFAULT_SECONDS if self.every_seconds is None else self.every_seconds
