"""`slam stitch`: frames to a mosaic, a pose for every frame, and the pictures that explain them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from slamcli.core.errors import InputError
from slamcli.core.records import PreparedFrame
from slamcli.io.calibrations import save_calibration
from slamcli.io.checkpoints import Checkpoint
from slamcli.io.frames import FrameFile, of_camera
from slamcli.io.map_file import MAP_NAME, save_map
from slamcli.io.outputs import locked_folder, move_folder, remove_folder, staging_folder
from slamcli.io.poses import write_poses
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.run.calibrate import self_calibration
from slamcli.run.command_report import Report
from slamcli.run.frame_loop import finish, registration_of, run_mapper
from slamcli.run.paint import outputs
from slamcli.run.paint.outputs import PaintedMaps
from slamcli.run.paint.scene import scenes_of
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.run.report import REPORT_NAME, write_report
from slamcli.run.session.session import Session
from slamcli.run.stitch import describing, exports, oblique, on_earth, report, resume, survey
from slamcli.run.stitch.debug_drawings import draw_trials
from slamcli.run.stitch.drive import Drive, LocatedDrive, open_drive
from slamcli.run.stitch.ground_scale import read_control, with_metres
from slamcli.run.stitch.options import StitchOptions
from slamcli.run.stitch.timing import TIMING_NAME, Timing
from slamcli.run.telemetry import TelemetryFiles, feed_shifted
from slamcli.selfcal import BRIEF, THOROUGH

_DRAWINGS = "matches"
# With so many frames compared, the fault of an odometry that contradicts them is clear.
_FRAMES_TO_NAME_A_FAULT = 16
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
    """Map an open drive into `output`; the other parameters are those of `stitch`.

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
    with (
        session.interruption.on_signals(),
        locked_folder(output),
        Checkpoint(output) as checkpoint,
    ):
        resumed = resume.begin(drive, checkpoint, overwrite=overwrite)
        replaced = overwrite or resumed
        with staging_folder(output, PRODUCTS, inputs=drive.paths, overwrite=replaced) as staging:
            if resumed:
                drive = resume.resume(drive, checkpoint, session)
            elif options.resume:
                session.notify("nothing to resume: no run was cut off; the run begins anew")
            timing.done("opening")
            located = locate_frames(drive, checkpoint, session)
            timing.done("locating")
            located = with_metres(self_calibrate(located, session), control)
            located = on_earth.on_earth(located)
            timing.done("self_calibrating")
            painted = paint(located, staging, checkpoint, session)
            timing.done("painting")
            write(located, staging, checkpoint, session)
            timing.done("writing")
            shown = write_report(staging, report.finished(located, painted, command), session)
            painted = replace(painted, unshown=shown)
            timing.done("reporting")
            timing.write(staging / TIMING_NAME, located.reached, session)
            if session.interruption.happened or painted.note or located.vanished:
                checkpoint.keep()
    interrupted = session.interruption.happened
    return report.report(located, painted, output, timing.seconds, interrupted=interrupted)


def locate_frames(drive: Drive, checkpoint: Checkpoint, session: Session) -> LocatedDrive:
    """First pass over the frames: each to its pose or the reason why it has none.

    Frames without a calibration are located as a survey when some of them contradict a rigid
    top-down mount, or when that leaves frames or maps apart and a survey connects more.
    """
    may_be_survey = survey.may_be_survey(drive)
    if may_be_survey and not drive.mapper.frame_count:
        found = survey.probe(drive.inputs.files, session)
        flown = on_earth.geotagged(drive.inputs.files)
        if found.free or found.apart or flown or drive.options.mount == "free":
            return _locate_uncalibrated(drive, found, checkpoint, session)
    located = _track_frames(drive, checkpoint, session)
    whole = _size(located)[0] == len(drive.inputs.files)
    if not may_be_survey or session.interruption.happened or whole:
        return located
    surveyed = _survey_frames(drive, *_describe_frames(drive, session), session)
    best = surveyed if _size(surveyed) > _size(located) else located
    few = 2 * _size(surveyed)[0] < len(drive.inputs.files)
    return _locate_by_pixels(drive, best, checkpoint, session) if few else best


def _locate_by_pixels(
    drive: Drive, best: LocatedDrive, checkpoint: Checkpoint, session: Session
) -> LocatedDrive:
    """Locate the frames of a camera that looks ahead over a floor of lines, if that places more.

    Raises
    ------
    InputError
        When it looks ahead and the frames do not determine it.
    """
    if drive.options.mount != "auto" or session.interruption.happened:
        return best
    size = drive.inputs.calibration.image_size
    files = of_camera(drive.inputs.files, size)
    camera = oblique.find_camera_by_pixels(files, session)
    if camera is None:
        return best
    located = _track_frames(oblique.with_camera(drive, camera, size), checkpoint, session)
    return located if _size(located) >= _size(best) else best


def _locate_uncalibrated(
    drive: Drive, found: survey.Probe, checkpoint: Checkpoint, session: Session
) -> LocatedDrive:
    """Locate frames that are not of a rigid top-down mount: of a camera that looks ahead, or not.

    Raises
    ------
    InputError
        When it looks ahead and the frames do not determine it.
    """
    described, vanished = _describe_frames(drive, session)
    features = [one.features for one in described]
    camera = None
    if drive.options.mount == "auto" and not session.interruption.happened:
        camera = oblique.find_camera(features, drive.inputs.files, session, apart=found.apart)
    if camera is None:
        return _survey_frames(drive, described, vanished, session)
    size = next(one.size for one in features if one is not None)
    return _track_frames(oblique.with_camera(drive, camera, size), checkpoint, session)


def _size(located: LocatedDrive) -> tuple[int, int]:
    """Return how many frames the largest map has, and how many all have."""
    fragments = placed_fragments(located.registered.estimates).values()
    sizes = [len(members) for members in fragments]
    return max(sizes, default=0), sum(sizes)


def _describe_frames(
    drive: Drive, session: Session
) -> tuple[list[describing.Described], tuple[str, ...]]:
    """Return the features of all frames, and the names of those that vanished meanwhile."""
    files, described, vanished = drive.inputs.files, list[describing.Described](), list[str]()
    missing = {file.index for file in files if not file.path.exists()}
    stage = session.on_this_machine().stage("describing", describing.describe_file, files)
    for file, one in zip(files, stage, strict=False):
        described.append(one)
        if not one.digest and file.index not in missing and not file.path.exists():
            vanished.append(file.name)
        if session.interruption.stops_here():
            break
    return described, tuple(vanished)


def _survey_frames(
    drive: Drive,
    described: Sequence[describing.Described],
    vanished: tuple[str, ...],
    session: Session,
) -> LocatedDrive:
    """Locate described frames as a survey."""
    found = survey.locate_survey(drive.inputs.files, described, drive, session.on_this_machine())
    drive = replace(drive, inputs=replace(drive.inputs, files=found.files))
    located = LocatedDrive(drive, drive.mapper, found.registered, Thumbnails(), vanished, "")
    return replace(located, survey=found.facts)


def _track_frames(drive: Drive, checkpoint: Checkpoint, session: Session) -> LocatedDrive:
    """Pass the frames through a mapper; those that a resumed one has seen are done.

    The state is saved now and then, the last time when a frame vanishes: a resumed run finds it
    again. From here on each file must keep the content that was read.
    """
    thumbnails, vanished = Thumbnails(), list[str]()
    files, mapper = list(drive.inputs.files), drive.mapper
    try:
        _locate(drive, files, thumbnails, vanished, checkpoint, session)
    except InputError:
        # The cluster is lost; what it located is not.
        if mapper.frame_count and not vanished:
            resume.save(mapper, files, checkpoint)
        raise
    _refuse_contradiction(drive, checkpoint)
    offset = feed_shifted(mapper, drive.telemetry) if drive.telemetry.find_time_offset else ""
    finish(mapper, session)
    _refuse_contradiction(drive, checkpoint)
    drive = replace(drive, inputs=replace(drive.inputs, files=files))
    registered = registration_of(mapper)
    return LocatedDrive(drive, mapper, registered, thumbnails, tuple(vanished), offset)


def _refuse_contradiction(drive: Drive, checkpoint: Checkpoint) -> None:
    """Refuse readings that contradict the frames: raises InputError, and nothing is to resume."""
    files, sensors = drive.telemetry_files, drive.mapper.sensors
    named = ((files.odometry, sensors.odometry_fault), (files.compass, sensors.compass_fault))
    for file, fault in named:
        if fault:
            checkpoint.close()
            raise InputError(f"{file} {fault}")


def _locate(
    drive: Drive,
    files: list[FrameFile],
    thumbnails: Thumbnails,
    vanished: list[str],
    checkpoint: Checkpoint,
    session: Session,
) -> None:
    """Pass the frames through the mapper; note each file's digest, and the names that vanished."""
    mapper, schedule = drive.mapper, resume.SaveSchedule()
    missing = {file.index for file in files if not file.path.exists()}

    def note_vanished(prepared: PreparedFrame) -> None:
        file = files[prepared.index]
        if not prepared.digest and file.index not in missing and not file.path.exists():
            # Of the frames before it: a resumed run goes on with this one.
            if not vanished and mapper.frame_count:
                resume.save(mapper, files, checkpoint)
            vanished.append(file.name)

    for prepared in run_mapper(mapper, files, session, thumbnails, note_vanished):
        done = prepared.index + 1
        files[prepared.index] = replace(files[prepared.index], digest=prepared.digest)
        if drive.options.debug:
            draw_trials(mapper.registrations, checkpoint.drawings)
        sensors = mapper.sensors
        if sensors.odometry_fault and sensors.compared >= _FRAMES_TO_NAME_A_FAULT:
            break
        stop = session.interruption.stops_here()
        if not vanished and (stop or schedule.due() or done == len(files)):
            schedule.run(lambda: resume.save(mapper, files, checkpoint))
        if stop:
            break


def self_calibrate(located: LocatedDrive, session: Session) -> LocatedDrive:
    """Refine the camera and the poses by the frames: always, or where these contradict it."""
    mode = located.drive.options.self_calibrate
    if mode == "never" or session.interruption.happened:
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
    located: LocatedDrive, staging: Path, checkpoint: Checkpoint, session: Session
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
        floor_map = replace(registered.floor_map, sources=sources, selection=options.selection)
        floor_map = replace(floor_map, datums=tuple(exports.datums(located.georeferences).items()))
        save_map(staging / MAP_NAME, floor_map)
    exports.write_exports(
        staging, options.export, registered, located.mapper.sensors, located.georeferences
    )
    report.write_run(staging / "run.toml", located, session)
    move_folder(checkpoint.drawings, staging / _DRAWINGS)
