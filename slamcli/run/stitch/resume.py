"""Resuming a stitch that was cut off: the key of its saved state, and when a state is saved."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from slamcli import __version__
from slamcli.io.checkpoints import Checkpoint, run_key
from slamcli.mapping.mapper import Mapper
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import Drive

# Raised whenever a class of the saved state moves or changes its fields: an older state is then
# another run's, of which there is nothing to resume.
_STATE_LAYOUT = 2
# A state is saved at most so often, and takes at most this share of the time.
_SAVE_SECONDS, _MAX_SAVE_SHARE = 5.0, 0.05


def resumed_mapper(drive: Drive, checkpoint: Checkpoint, session: Session) -> Mapper:
    """Return the mapper of a run that was cut off, if one is to be resumed; else the drive's."""
    inputs, files, options = drive.inputs, drive.telemetry_files, drive.options
    paths = [file.path for file in inputs.files]
    others = (inputs.calibration_path, files.odometry, files.compass, files.gps)
    paths += [path for path in others if path is not None]
    # How a run is reported is no part of what it computes.
    plain = replace(options, resume=False, strict=False)
    key = run_key(f"{__version__} layout {_STATE_LAYOUT} {plain!r}", paths)
    if checkpoint.open(key, resume=options.resume):
        mapper = checkpoint.load()
        if isinstance(mapper, Mapper):
            located, total = len(mapper.estimates), len(inputs.files)
            session.notify(f"resumed: {located} of {total} frames had been located")
            return mapper
    if options.resume:
        session.notify(
            "nothing to resume: no run of these frames and options was cut off; starting anew"
        )
    return drive.mapper


class SaveSchedule:
    """When to save the next state: after some seconds, for a limited share of the time."""

    def __init__(self) -> None:
        self._wait_seconds, self._last = _SAVE_SECONDS, time.monotonic()

    def due(self) -> bool:
        """Return whether to save now."""
        return time.monotonic() - self._last >= self._wait_seconds

    def run(self, save: Callable[[], None]) -> None:
        """Save, and set the time of the next by how long it took."""
        started = time.monotonic()
        save()
        self._last = time.monotonic()
        self._wait_seconds = max(_SAVE_SECONDS, (self._last - started) / _MAX_SAVE_SHARE)
