"""`slam stitch`: frames to a mosaic, a pose for every frame, and the pictures that explain them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from slamcli.io.calibrations import save_calibration
from slamcli.io.checkpoints import Checkpoint
from slamcli.io.map_file import MAP_NAME, save_map
from slamcli.io.outputs import locked_folder, move_folder, remove_folder, staging_folder
from slamcli.io.poses import write_poses
from slamcli.run import self_calibration
from slamcli.run.command_report import Report
from slamcli.run.paint import outputs
from slamcli.run.paint.outputs import PaintedMaps
from slamcli.run.paint.scene import scenes_of
from slamcli.run.report import REPORT_NAME, write_report
from slamcli.run.report.pictures import KeptPictures
from slamcli.run.session.session import Session
from slamcli.run.stitch import (
    exports,
    locating,
    on_earth,
    report,
    resume,
)
from slamcli.run.stitch.drive import Drive, LocatedDrive, open_drive
from slamcli.run.stitch.ground_scale import read_control, with_metres
from slamcli.run.stitch.keyframes import with_keyframes
from slamcli.run.stitch.options import StitchOptions
from slamcli.run.stitch.timing import TIMING_NAME, Timing
from slamcli.run.telemetry import TelemetryFiles
from slamcli.selfcal import BRIEF, THOROUGH

_DRAWINGS = "matches"
PRODUCTS = (
    "poses.csv",
    "run.toml",
    "calibration.yaml",
    MAP_NAME,
    REPORT_NAME,
    TIMING_NAME,
    *outputs.PRODUCTS,
    *exports.PRODUCTS,
    _DRAWINGS,
)


def stitch(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    options: StitchOptions,
    *,
    telemetry: TelemetryFiles | None = None,
    overwrite: bool,
    session: Session,
    command: str = "",
) -> Report:
    """Map the frames of folders or files into `output`.

    Parameters
    ----------
    command : str
        The command line that repeats the run, for report.html.

    Raises
    ------
    InputError, CalibrationError, MapError, OutputError
    """
    timing = Timing()
    drive = open_drive(sources, calibration_path, options, telemetry or TelemetryFiles(), session)
    with session.interruption.on_signals(), locked_folder(output):
        return stitch_drive(
            drive, output, timing, overwrite=overwrite, session=session, command=command
        )


def stitch_drive(
    drive: Drive,
    output: Path,
    timing: Timing,
    *,
    overwrite: bool,
    session: Session,
    command: str = "",
) -> Report:
    """Map an open drive into `output`, a locked folder; the other parameters are those of `stitch`.

    Parameters
    ----------
    drive : Drive
        Frames that its mapper has seen are located already.
    timing : Timing
        Runs since the drive was opened.

    Raises
    ------
    InputError, CalibrationError, MapError, OutputError
    """
    options = drive.options
    control = read_control(options, drive.inputs.files)
    with Checkpoint(output) as checkpoint:
        resumed = resume.begin(drive, checkpoint, overwrite=overwrite)
        replaced = overwrite or resumed
        with staging_folder(output, PRODUCTS, inputs=drive.paths, overwrite=replaced) as staging:
            if resumed:
                drive = resume.resume(drive, checkpoint, session)
            elif options.resume:
                session.notify("nothing to resume: no run was cut off; the run begins anew")
            timing.done("opening")
            located = locating.locate_frames(drive, checkpoint, session)
            timing.done("locating")
            located = with_metres(self_calibrate(located, session), control)
            located = on_earth.on_earth(located)
            timing.done("self_calibrating")
            pictures = KeptPictures(located.drive.inputs.files, located.estimates)
            painted = paint(located, staging, checkpoint, session, pictures)
            timing.done("painting")
            write(located, staging, checkpoint, session)
            timing.done("writing")
            run = report.finished(located, painted, command)
            shown = write_report(staging, run, session, pictures.urls)
            painted = replace(painted, unshown=shown)
            timing.done("reporting")
            timing.write(staging / TIMING_NAME, located.reached, session)
            if session.interruption.happened or painted.note or located.vanished:
                checkpoint.keep()
    interrupted = session.interruption.happened
    return report.report(located, painted, output, timing.seconds, interrupted=interrupted)


def self_calibrate(located: LocatedDrive, session: Session) -> LocatedDrive:
    """Refine the camera and the poses by the frames: always, or where these contradict it."""
    mode = located.drive.options.self_calibrate
    if mode == "never" or session.interruption.happened or located.survey is not None:
        return located
    if mode == "auto":
        if located.drive.options.extend is not None or located.drive.telemetry_files.any:
            return located
        contradicted, note = self_calibration.look(
            located.drive.inputs, located.registered, session
        )
        if not contradicted:
            return replace(located, camera_note=note)
    refined = self_calibration.self_calibrate(
        located.drive.inputs,
        located.registered,
        located.mapper.options,
        session,
        BRIEF if mode == "auto" else THOROUGH,
    )
    return replace(located, registered=refined.registration, self_calibration=refined)


def paint(
    located: LocatedDrive,
    staging: Path,
    checkpoint: Checkpoint,
    session: Session,
    pictures: KeptPictures,
) -> PaintedMaps:
    """Second pass over the frames: from their final poses into the mosaics, in every format."""
    files, products = located.drive.inputs.files, located.drive.options.products
    scenes = scenes_of(
        located.calibration,
        located.estimates,
        lambda estimate: files[estimate.index],
        products,
        exports.datums(located.georeferences),
        located.thumbnails,
    )
    scenes = [replace(scene, keep_picture=pictures.keep) for scene in scenes]
    # More frames would change the poses: a resumed run cannot use the tiles of this one.
    unfinished = staging / "tiles"
    kept = resume.tiles(located.drive.options, checkpoint)
    tiles = unfinished if session.interruption.happened else kept
    painted = outputs.write_maps(scenes, products, staging, tiles, session)
    remove_folder(unfinished)
    return painted


def write(located: LocatedDrive, staging: Path, checkpoint: Checkpoint, session: Session) -> None:
    """Write all but the pictures of the map."""
    options, registered = located.drive.options, located.registered
    write_poses(staging / "poses.csv", located.estimates)
    if located.self_calibration is not None:
        save_calibration(staging / "calibration.yaml", located.calibration)
    if registered.floor_map is not None:
        sources = tuple(located.drive.sources)
        floor_map = with_keyframes(registered.floor_map, located, session)
        floor_map = replace(floor_map, sources=sources, selection=options.selection)
        floor_map = replace(floor_map, datums=tuple(exports.datums(located.georeferences).items()))
        save_map(staging / MAP_NAME, floor_map)
    exports.write_exports(
        staging, options.export, registered, located.mapper.sensors, located.georeferences
    )
    report.write_run(staging / "run.toml", located, session)
    move_folder(checkpoint.drawings, staging / _DRAWINGS)
