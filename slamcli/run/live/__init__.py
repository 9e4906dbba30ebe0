"""`slam live`: a camera mapped, or located in a finished map, while it runs; shown on a page."""

from __future__ import annotations

import shlex
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread

from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import CalibrationError, InputError, OutputError
from slamcli.core.exit_codes import of_placement
from slamcli.core.records import PoseEstimate
from slamcli.io.calibrations import load_calibration
from slamcli.io.live_camera import LiveCamera
from slamcli.io.loopback import LoopbackServer
from slamcli.io.map_file import load_map
from slamcli.io.outputs import refuse_earlier, refuse_existing
from slamcli.io.poses import write_poses
from slamcli.mapping.mapper import Mapper
from slamcli.run.command_report import Report
from slamcli.run.frame_loop import read_and_prepare
from slamcli.run.inputs import CALIBRATION_NAME, NO_CALIBRATION, Inputs
from slamcli.run.live.page import LivePage
from slamcli.run.live.recording import Recording, frame_of
from slamcli.run.live.trackers import locating, mapping
from slamcli.run.session.session import Session
from slamcli.run.stitch import PRODUCTS, stitch_drive
from slamcli.run.stitch.drive import Drive
from slamcli.run.stitch.options import StitchOptions
from slamcli.run.stitch.timing import Timing
from slamcli.run.telemetry import Telemetry, TelemetryFiles

_OUTPUT = "live_mosaic"


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """How a live camera is used.

    Attributes
    ----------
    floor_map : Path or None
        A finished map to locate in; None makes one.
    record : Path or None
        New folder that keeps the frames.
    max_frames : int or None
        Ends after this many.
    port : int
        Of the page; 0 takes a free one.
    browser : bool
        Open the page.
    overwrite : bool
        Replace earlier results.
    """

    floor_map: Path | None = None
    record: Path | None = None
    max_frames: int | None = None
    port: int = 0
    browser: bool = True
    overwrite: bool = False


def live(
    source: str,
    calibration_path: Path | None,
    output: Path | None,
    options: LiveOptions,
    session: Session,
) -> Report:
    """Map what a camera sees, or locate it, until it is interrupted or the stream ends.

    Parameters
    ----------
    source : str
        See `LiveCamera`.
    calibration_path : Path or None
        None takes calibration.yaml of the current folder; without one, lengths are in pixels.
    output : Path or None
        Folder of the map, written as `stitch` does; where a finished map is given, a CSV of poses.

    Raises
    ------
    InputError, CalibrationError, MapError, OutputError
    """
    if options.floor_map is not None:
        return _locate(source, options.floor_map, output, options, session)
    return _map(source, calibration_path, output or Path(_OUTPUT), options, session)


def _map(
    source: str,
    calibration_path: Path | None,
    output: Path,
    options: LiveOptions,
    session: Session,
) -> Report:
    timing = Timing()
    refuse_earlier(output, PRODUCTS, inputs=[calibration_path], overwrite=options.overwrite)
    with LiveCamera(source) as camera, _folder(options.record, output) as folder:
        calibration, path, note = _calibration(calibration_path, camera.size)
        mapper, recording = Mapper(calibration, MapperOptions()), Recording(folder)
        page = LivePage(source, camera, mapping(mapper))
        _run(page, recording, options, session)
        timing.done("live")
        drive = Drive(
            () if options.record is None else (folder,),
            Inputs(recording.files, calibration, path, f"{note}\n{page.counts}".strip()),
            TelemetryFiles(),
            Telemetry([], [], [], find_time_offset=False),
            StitchOptions(MapperOptions()),
            mapper,
        )
        return stitch_drive(
            drive,
            output,
            timing,
            overwrite=options.overwrite,
            session=replace(session, interruption=session.interruption.renewed()),
            command=_repeating(options.record, path),
        )


def _locate(
    source: str, floor_map: Path, output: Path | None, options: LiveOptions, session: Session
) -> Report:
    if output is not None:
        refuse_existing(output, inputs=[floor_map], overwrite=options.overwrite)
    tracker = locating(load_map(floor_map))
    with LiveCamera(source) as camera:
        _check_size(tracker.calibration, camera.size, floor_map)
        recording = None if options.record is None else Recording(options.record)
        page = LivePage(source, camera, tracker)
        found = _run(page, recording, options, session)
    if output is not None:
        write_poses(output, found)
    placed = sum(estimate.map_from_robot is not None for estimate in found)
    lines = [page.counts, f"{placed} of {len(found)} frames are on the map"]
    lines += [f"written to {path}" for path in (output, options.record) if path is not None]
    facts = {"frames": len(found), "placed": placed, "output": output, "record": options.record}
    return Report(tuple(lines), facts, of_placement(placed, len(found)))


def _run(
    page: LivePage, recording: Recording | None, options: LiveOptions, session: Session
) -> list[PoseEstimate]:
    """Pass the camera's pictures through a tracker; return each frame's estimate as it came."""
    tracker, found = page.tracker, list[PoseEstimate]()
    with _served(page, options, session):
        with session.interruption.on_signals():
            for shot in page.moving(session.interruption.stops_here):
                index = len(found)
                if recording is None:
                    prepared = tracker.prepare(frame_of(shot, index))
                else:
                    prepared = read_and_prepare(tracker.prepare, recording.keep(shot, index))
                    recording.note_digest(prepared)
                found.append(tracker.place(prepared))
                page.show(found[-1])
                if page.is_line_due():
                    session.notify(page.line)
                if len(found) == options.max_frames:
                    break
        session.notify(page.line)
    if not found:
        raise InputError("ended before the first frame")
    return found


def _repeating(record: Path | None, calibration: Path | None) -> str:
    """Return the command that maps the recording again; empty without one."""
    given = [] if calibration is None else ["-c", str(calibration)]
    return "" if record is None else shlex.join(["slam", "stitch", str(record), *given])


@contextmanager
def _served(page: LivePage, options: LiveOptions, session: Session) -> Iterator[None]:
    """Serve the page meanwhile."""
    server = LoopbackServer(page.answer, options.port)
    thread = Thread(target=server.serve, daemon=True)
    thread.start()
    session.notify(f"{server.address} shows the camera and the map; Ctrl-C ends it")
    if options.browser:
        webbrowser.open(server.address)
    try:
        yield
    finally:
        server.close()
        thread.join()


@contextmanager
def _folder(record: Path | None, output: Path) -> Iterator[Path]:
    """Yield the folder that keeps the frames, for this run alone unless it is to be kept."""
    if record is not None:
        yield record
        return
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        made = TemporaryDirectory(prefix=f".{output.name}-live-", dir=output.parent)
    except OSError as error:
        raise OutputError(f"cannot write {output}: {error.strerror or error}") from error
    with made as folder:
        yield Path(folder)


def _calibration(path: Path | None, size: tuple[int, int]) -> tuple[Calibration, Path | None, str]:
    """Return the camera, its file and a note on it; raises CalibrationError."""
    note = ""
    if path is None and Path(CALIBRATION_NAME).is_file():
        path = Path(CALIBRATION_NAME)
        note = f"calibration found: {path}"
    if path is None:
        return top_down_calibration(size), None, NO_CALIBRATION
    calibration = load_calibration(path)
    _check_size(calibration, size, path)
    return calibration, path, note


def _check_size(calibration: Calibration, size: tuple[int, int], path: Path) -> None:
    wanted = calibration.image_size
    if size != wanted:
        raise CalibrationError(
            f"{path} is for {wanted[0]}x{wanted[1]} images, but the camera gives "
            f"{size[0]}x{size[1]}; set the camera to that size, or calibrate with its own photo"
        )
