"""Resuming a stitch that was cut off: the key of its saved state, and when a state is saved."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from slamcli import __version__
from slamcli.core.config import ProductOptions
from slamcli.core.errors import InputError
from slamcli.io.checkpoints import Checkpoint, run_key
from slamcli.io.frames import FrameFile
from slamcli.io.record_columns import from_columns, to_columns
from slamcli.mapping.mapper import Mapper
from slamcli.mapping.saved_state import MapperState, check
from slamcli.run.frame_loop import read_and_prepare
from slamcli.run.session.session import Session
from slamcli.run.stitch.drive import Drive
from slamcli.run.stitch.options import StitchOptions

# Raised whenever a class of the saved state moves or changes its fields: an older state is then
# another run's, of which there is nothing to resume.
_STATE_LAYOUT = 6
# A state is saved at most so often, and takes at most this share of the time.
_SAVE_SECONDS, _MAX_SAVE_SHARE = 5.0, 0.05


def begin(drive: Drive, checkpoint: Checkpoint, *, overwrite: bool) -> bool:
    """Begin a run; return whether one that was cut off is resumed.

    Raises
    ------
    OutputError
        When there is one that was cut off, and it is neither to be resumed nor overwritten.
    """
    # A run may be gone on with that is painted, written or reported in another way.
    located_by = replace(
        drive.options,
        products=ProductOptions(),
        self_calibrate="never",
        export=(),
        resume=False,
        strict=False,
    )
    key = run_key(f"{__version__} layout {_STATE_LAYOUT} {located_by!r}", drive.paths)
    resumed = checkpoint.begin(key, resume=drive.options.resume, overwrite=overwrite)
    if not resumed:
        # A survey saves no other state: what it has painted is found by this one.
        checkpoint.save({}, 0, len(drive.inputs.files))
    return resumed


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """The state of a mapper, and the digests of the files of the frames that it has seen."""

    mapper: MapperState
    digests: list[bytes]


def resume(drive: Drive, checkpoint: Checkpoint, session: Session) -> Drive:
    """Bring the drive's mapper to where a run that was cut off has saved its state.

    The drive that is returned accepts no other content of the frames that were read.

    When the latest state is damaged, that is to the one before; without one the run begins anew,
    and the finished tiles are of use all the same.

    Raises
    ------
    InputError
        When a state whose checksum is right cannot be that of this run.
    """
    columns, faults = checkpoint.load()
    for fault in faults:
        session.notify(f"{fault}; the run goes on without it")
    if not columns:
        session.notify("resumed: no located frames were saved; all are located anew")
        return drive
    try:
        state = from_columns(_State, columns)
        check(state.mapper)
        known = zip(drive.inputs.files, state.digests, strict=False)
        files = [replace(file, digest=digest) for file, digest in known]
        files += drive.inputs.files[len(files) :]
        prepared = {
            index: read_and_prepare(drive.mapper.prepare, files[index])
            for index in sorted(state.mapper.tracking.indices)
        }
        lost = [files[i] for i, one in prepared.items() if one.digest != files[i].digest]
        if lost:
            raise InputError(f"cannot resume: {lost[0].path} vanished or changed; put it back")
        drive.mapper.restore(state.mapper, prepared)
    except (ValueError, LookupError, cv2.error) as error:
        raise InputError(
            f"the state in {checkpoint.folder} is of no use ({error}); --overwrite to begin anew"
        ) from error
    located = drive.mapper.frame_count
    session.notify(f"resumed: {located} of {len(files)} frames had been located")
    return replace(drive, inputs=replace(drive.inputs, files=files))


def tiles(options: StitchOptions, checkpoint: Checkpoint) -> Path:
    """Return the folder of the tiles that are painted with these options."""
    return checkpoint.tiles(f"{options.products!r} {options.self_calibrate}")


def save(mapper: Mapper, files: Sequence[FrameFile], checkpoint: Checkpoint) -> None:
    """Save a mapper's state after some of all frames; raises OutputError."""
    located = mapper.frame_count
    digests = [file.digest for file in files[:located]]
    columns = to_columns(_State, _State(mapper.state(), digests))
    checkpoint.save(columns, located, len(files))


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
