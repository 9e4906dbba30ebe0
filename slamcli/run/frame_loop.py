"""Files of frames through a mapper: read and prepared ahead, placed one by one in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import FrameError
from slamcli.core.records import Frame, PreparedFrame
from slamcli.io.frames import FrameFile, read_frame
from slamcli.mapping.mapper import Mapper
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.run.session.executor import Progress, ordered, threads
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
    return prepare(frame)


def walk(
    mapper: Mapper,
    files: Sequence[FrameFile],
    workers: int,
    progress: Progress,
    scheduler: str = "",
    thumbnails: Thumbnails | None = None,
) -> Iterator[int]:
    """Give a mapper all frames that it has not seen; yield after each how many it has by then.

    Parameters
    ----------
    glimpses : Thumbnails or None
        Keeps what the frames look like, where they are read by this process.
    """
    first = len(mapper.estimates)
    work = partial(read_and_prepare, mapper.prepare, thumbnails=None if scheduler else thumbnails)
    prepared_frames = ordered(work, files[first:], workers, scheduler)
    for done, prepared in enumerate(prepared_frames, start=first + 1):
        mapper.step(prepared)
        progress("locating", done, len(files))
        yield done


def finish(mapper: Mapper, workers: int) -> None:
    """Weigh all that a mapper has measured, its loops looked for on so many threads."""
    with threads(workers) as executor:
        mapper.finish(executor.map)


def register(
    files: Sequence[FrameFile],
    options: MapperOptions,
    workers: int,
    progress: Progress,
    calibration: Calibration,
) -> RegisteredDrive:
    """Place all frames with one calibration."""
    mapper = Mapper(calibration, options)
    for _ in walk(mapper, files, workers, progress):
        pass
    finish(mapper, workers)
    return registration_of(mapper)


def registration_of(mapper: Mapper) -> RegisteredDrive:
    """Return what a mapper knows when all frames have come."""
    return RegisteredDrive(
        mapper.calibration,
        mapper.estimates,
        mapper.links,
        mapper.switched_off,
        mapper.floor_map(),
    )
