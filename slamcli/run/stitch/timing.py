"""timing.toml: how long each part of a run took, apart from all that is the same for every run."""

from __future__ import annotations

import time
from pathlib import Path

from slamcli.io import toml
from slamcli.run.session.session import Session

TIMING_NAME = "timing.toml"


class Timing:
    """A clock that runs from its making, with a reading after each part of a run."""

    def __init__(self) -> None:
        self._begin = self._last = time.monotonic()
        self._parts: dict[str, toml.Scalar] = {}

    @property
    def seconds(self) -> float:
        """Time since the clock was made."""
        return time.monotonic() - self._begin

    def done(self, part: str) -> None:
        """Note the time since the part before."""
        now = time.monotonic()
        self._parts[f"{part}_seconds"] = round(now - self._last, 3)
        self._last = now

    def write(self, path: Path, frames: int, session: Session) -> None:
        """Write the parts, their sum, and the workers that it took."""
        total = self._last - self._begin
        head: dict[str, toml.Scalar] = {
            "seconds": round(total, 3),
            "frames": frames,
            "frames_per_second": round(frames / total, 3) if total > 0 else None,
            "workers": session.workers,
        }
        toml.write_toml(path, {"": head, "parts": self._parts})
