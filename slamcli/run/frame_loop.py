"""The frame loop: files read and prepared ahead, then passed through a mapper in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.records import Frame, PreparedFrame
from slamcli.io.frames import FrameFile, read_frame
from slamcli.mapping.mapper import Mapper
from slamcli.mapping.self_calibration import registration_of
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.run.session.session import Session
from slamcli.selfcal import RegisteredDrive


def read_and_prepare(
    prepare: Callable[[Frame], PreparedFrame], file: FrameFile, thumbnails: Thumbnails | None = None
) -> PreparedFrame:
    """Return a frame ready to be placed, or with the reason why it cannot be used."""
    try:
        frame = read_frame(file, gray=True)
    except FrameError as error:
        return PreparedFrame(file.index, file.name, file.stamp, None, None, str(error))
    if thumbnails is not None:
        thumbnails.keep(frame)
    return replace(prepare(frame), digest=frame.digest)


def run_mapper(
    mapper: Mapper,
    files: Sequence[FrameFile],
    session: Session,
    thumbnails: Thumbnails | None = None,
    before_step: Callable[[PreparedFrame], object] = lambda _prepared: None,
    stop: int | None = None,
) -> Iterator[PreparedFrame]:
    """Pass the frames that a mapper has not seen through it; yield each when it has been.

    Parameters
    ----------
    thumbnails : Thumbnails or None
        Takes the frames' thumbnails, where this process reads them.
    before_step : function
        Called with each frame when the mapper has seen only those before it.
    stop : int or None
        How many frames the mapper is to have seen in the end; None for all.
    """
    first = mapper.frame_count
    kept = None if session.scheduler else thumbnails
    # A single thread has no time to spare, and another process does not know the keyframes.
    spare = session.workers > 1 and not session.scheduler
    prepare = mapper.prepare_ahead if spare else mapper.prepare
    work = partial(read_and_prepare, prepare, thumbnails=kept)
    for done, prepared in enumerate(session.ordered(work, files[first:stop]), start=first + 1):
        before_step(prepared)
        mapper.step(prepared)
        session.progress("locating", done, len(files))
        yield prepared


def finish(mapper: Mapper, files: Sequence[FrameFile], session: Session) -> None:
    """Close the remaining loops, on the session's threads, and optimise the whole pose graph.

    Lost frames that the poses around them predict are then read and registered once more.
    """

    def prepare_again(indices: Sequence[int]) -> Iterator[PreparedFrame]:
        chosen = [files[index] for index in indices]
        return session.ordered(partial(read_and_prepare, mapper.prepare), chosen)

    with session.threads() as executor:
        mapper.finish(executor.map, None if session.interruption.happened else prepare_again)


def register(
    files: Sequence[FrameFile], options: MapperOptions, session: Session, calibration: Calibration
) -> RegisteredDrive:
    """Return the poses of all frames for one calibration."""
    mapper = Mapper(calibration, options)
    for _ in run_mapper(mapper, files, session):
        pass
    finish(mapper, files, session)
    return registration_of(mapper)
