"""`slam live`: a camera mapped, or located in a finished map, while it runs; shown on a page."""

from __future__ import annotations

import shlex
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread

from slamcli.core.camera.calibration import Calibration, top_down_calibration
from slamcli.core.config import MapperOptions
from slamcli.core.errors import CalibrationError, InputError, OutputError
from slamcli.core.exit_codes import of_placement
from slamcli.core.records import PoseEstimate
from slamcli.io.calibrations import load_calibration
from slamcli.io.checkpoints import Checkpoint
from slamcli.io.live_camera import LiveCamera
from slamcli.io.loopback import LoopbackServer
from slamcli.io.map_file import load_map
from slamcli.io.outputs import locked_folder, refuse_earlier, refuse_existing, remove_folder
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
# Where the frames are until the map is written, in its folder.
_KEPT = "live_frames"


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
    _check_output(output, calibration_path, options)
    painting = replace(session, interruption=session.interruption.renewed())
    with (
        LiveCamera(source) as camera,
        locked_folder(output),
        _folder(options, output, calibration_path, painting) as folder,
    ):
        Checkpoint(output).begin("", resume=False, overwrite=options.overwrite)
        calibration, path, note = _calibration(calibration_path, camera.size)
        mapper, recording = Mapper(calibration, MapperOptions()), Recording(folder)
        page = LivePage(source, camera, mapping(mapper))
        _run(page, recording, options, session, [])
        timing.done("live")
        drive = Drive(
            () if options.record is None else (folder,),
            Inputs(recording.files, calibration, path, f"{note}\n{page.counts}".strip()),
            TelemetryFiles(),
            Telemetry([], [], [], find_time_offset=False),
            StitchOptions(MapperOptions()),
            mapper,
        )
        with painting.interruption.on_signals():
            return stitch_drive(
                drive,
                output,
                timing,
                overwrite=options.overwrite,
                session=painting,
                command=_repeating(options.record, path),
            )


def _check_output(output: Path, calibration_path: Path | None, options: LiveOptions) -> None:
    """Refuse, before the drive, a folder that the map cannot be written into."""
    refuse_earlier(output, PRODUCTS, inputs=[calibration_path], overwrite=options.overwrite)
    kept = output / _KEPT
    if kept.exists() and any(kept.iterdir()) and not options.overwrite:
        raise OutputError(
            f"{kept} has the frames of a live run that was cut off: slam stitch {kept} maps them, "
            "--overwrite deletes them"
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
        found: list[PoseEstimate] = []
        try:
            _run(page, recording, options, session, found)
        finally:
            # Also of a run that fails, as on a disk that the recording fills.
            if output is not None and found:
                write_poses(output, found)
    placed = sum(estimate.map_from_robot is not None for estimate in found)
    lines = [page.counts, f"{placed} of {len(found)} frames are on the map"]
    lines += [f"written to {path}" for path in (output, options.record) if path is not None]
    facts = {"frames": len(found), "placed": placed, "output": output, "record": options.record}
    return Report(tuple(lines), facts, of_placement(placed, len(found)))


def _run(
    page: LivePage,
    recording: Recording | None,
    options: LiveOptions,
    session: Session,
    found: list[PoseEstimate],
) -> None:
    """Pass the camera's pictures through a tracker; each frame's estimate is added to `found`."""
    tracker = page.tracker
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
def _folder(
    options: LiveOptions, output: Path, calibration_path: Path | None, session: Session
) -> Iterator[Path]:
    """Yield the folder that keeps the frames; unless it was named, it goes when the map is written.

    A run that fails, is killed, or is interrupted while it writes the map leaves it.
    """
    # What the folder was before the camera was open may have changed.
    _check_output(output, calibration_path, options)
    if options.record is not None:
        yield options.record
        return
    folder, complete = output / _KEPT, False
    remove_folder(folder)
    try:
        yield folder
        complete = not session.interruption.happened
    finally:
        if complete:
            remove_folder(folder)
        elif folder.exists():
            session.notify(f"the frames are kept: slam stitch {folder} maps them")


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
