"""First pass over the frames: each to its pose, or the reason why it has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from slamcli.core.errors import InputError
from slamcli.core.geometry import wrap_angle
from slamcli.core.records import PreparedFrame
from slamcli.io.checkpoints import Checkpoint
from slamcli.io.frames import FrameFile, of_camera
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.mapping.self_calibration import registration_of
from slamcli.run.frame_loop import finish, run_mapper
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.run.session.session import Session
from slamcli.run.stitch import (
    describing,
    oblique,
    on_earth,
    resume,
    rocking,
    survey,
)
from slamcli.run.stitch.debug_drawings import draw_trials
from slamcli.run.stitch.drive import Drive, LocatedDrive
from slamcli.run.telemetry import feed_shifted
from slamcli.survey.ideal_picture import ideal_picture

# With so many frames compared, the fault of an odometry that contradicts them is clear.
_FRAMES_TO_NAME_A_FAULT = 16
# Where of the first so many frames more than this share is not in one map, the camera may be
# carried by hand [benchmarks/free_cameras.py].
_FRAMES_TO_LOOK_AGAIN, _LOST_SHARE = (8, 24, 64), 0.25

# Frames without a calibration that lie within this share of the picture and this turn of the first
# [tests/survey/test_static_light.py: vignetting leaves 0.01; the backend's limits are the same].
_STANDING_SHARE, _STANDING_RADIANS = 0.03, 0.1


def locate_frames(drive: Drive, checkpoint: Checkpoint, session: Session) -> LocatedDrive:
    """First pass over the frames: each to its pose or the reason why it has none.

    Frames without a calibration are located as a survey when some of them contradict a rigid
    top-down mount, or when that leaves frames or maps apart and a survey connects more.
    """
    may_be_survey = survey.may_be_survey(drive)
    if may_be_survey and (drive.intrinsics is not None or drive.options.unordered):
        return _locate_uncalibrated(drive, survey.NO_PROBE, checkpoint, session)
    if may_be_survey and not drive.mapper.frame_count:
        found = survey.probe(drive.inputs.files, session)
        flown = on_earth.geotagged(drive.inputs.files)
        if found.free or found.apart or flown or drive.options.moves_freely:
            return _locate_uncalibrated(drive, found, checkpoint, session)
    if rocking.may_rock(drive):
        return _locate_calibrated(drive, checkpoint, session)
    located = _track_frames(drive, checkpoint, session)
    whole = _size(located)[0] == len(drive.inputs.files)
    if not may_be_survey or session.interruption.happened or whole:
        return located
    surveyed = _survey_frames(
        drive, *describing.describe_frames(drive.inputs.files, session), session
    )
    better = _size(surveyed) > _size(located) or _stands(located)
    best = surveyed if better else located
    few = 2 * _size(surveyed)[0] < len(drive.inputs.files)
    return _locate_by_pixels(drive, best, checkpoint, session) if few else best


def _locate_calibrated(drive: Drive, checkpoint: Checkpoint, session: Session) -> LocatedDrive:
    """Locate the frames of a calibrated camera: of a robot, or carried by hand.

    The second is looked for where many of the first frames are lost, and at the end.
    """
    files, start = drive.inputs.files, None
    looked = drive.options.moves_freely or drive.options.unordered
    for count in _FRAMES_TO_LOOK_AGAIN:
        if looked or count >= len(files) or count <= drive.mapper.frame_count:
            continue
        start = _track_frames(drive, checkpoint, session, stop=count, before=start)
        lost = start.reached - _size(start)[0]
        if lost > _LOST_SHARE * start.reached:
            looked = rocking.rocks(start, session)
            break
    if looked and not session.interruption.happened:
        surveyed = _survey_calibrated(drive, session)
        if 2 * _size(surveyed)[0] > len(files):
            return surveyed
    located = _track_frames(drive, checkpoint, session, before=start)
    placed = _size(located)[0]
    if looked or placed == len(files) or session.interruption.happened:
        return located
    if 2 * placed > len(files) and not rocking.rocks(located, session):
        return located
    surveyed = _survey_calibrated(drive, session)
    return surveyed if _size(surveyed) > _size(located) else located


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
    ideal = None if drive.intrinsics is None else ideal_picture(drive.intrinsics)
    described, vanished = describing.describe_frames(drive.inputs.files, session, ideal)
    features = [one.features for one in described]
    camera = None
    if drive.options.mount == "auto" and not session.interruption.happened:
        camera = oblique.find_camera(features, drive, session, apart=found.apart)
    if camera is None:
        return _survey_frames(drive, described, vanished, session)
    size = next(one.size for one in features if one is not None)
    return _track_frames(oblique.with_camera(drive, camera, size), checkpoint, session)


def _size(located: LocatedDrive) -> tuple[int, int]:
    """Return how many frames the largest map has, and how many all have."""
    fragments = placed_fragments(located.registered.estimates).values()
    sizes = [len(members) for members in fragments]
    return max(sizes, default=0), sum(sizes)


def _stands(located: LocatedDrive) -> bool:
    """Return whether no frame of the largest map lies apart from its first.

    What moves with the camera, as its vignetting does, looks like this; frames of a camera that
    stands are all placed.
    """
    poses = [one.map_from_robot for one in located.registered.estimates if one.fragment == 0]
    known = [pose for pose in poses if pose is not None]
    if not known:
        return False
    apart = max((known[0].inverse() @ pose).translation_length for pose in known)
    turn = max(abs(wrap_angle(pose.theta - known[0].theta)) for pose in known)
    limit = _STANDING_SHARE * max(located.drive.inputs.calibration.image_size)
    return apart < limit and turn < _STANDING_RADIANS


def _survey_frames(
    drive: Drive,
    described: Sequence[describing.Described],
    vanished: tuple[str, ...],
    session: Session,
) -> LocatedDrive:
    """Locate described frames as a survey."""
    found = survey.locate_survey(drive.inputs.files, described, drive, session.on_this_machine())
    return _with_survey(drive, found, vanished)


def _survey_calibrated(drive: Drive, session: Session) -> LocatedDrive:
    """Locate the frames of a calibrated camera that is carried by hand."""
    ideal = ideal_picture(drive.inputs.calibration)
    described, vanished = describing.describe_frames(drive.inputs.files, session, ideal)
    found = survey.locate_calibrated(described, drive, session.on_this_machine())
    return _with_survey(drive, found, vanished)


def _with_survey(
    drive: Drive, found: survey.SurveyedDrive, vanished: tuple[str, ...]
) -> LocatedDrive:
    drive = replace(drive, inputs=replace(drive.inputs, files=found.files))
    located = LocatedDrive(drive, drive.mapper, found.registered, Thumbnails(), vanished, "")
    return replace(located, survey=found.facts)


def _track_frames(
    drive: Drive,
    checkpoint: Checkpoint,
    session: Session,
    *,
    stop: int | None = None,
    before: LocatedDrive | None = None,
) -> LocatedDrive:
    """Pass the frames through a mapper; those that it has seen are done.

    The state is saved now and then, the last time when a frame vanishes: a resumed run finds it
    again. From here on each file must keep the content that was read.

    Parameters
    ----------
    stop : int or None
        Stop when the mapper has seen so many frames, with the map not yet optimised.
    before : LocatedDrive or None
        What such a call returned.
    """
    thumbnails, vanished = Thumbnails(), list[str]()
    if before is not None:
        drive, thumbnails, vanished = before.drive, before.thumbnails, list(before.vanished)
    files, mapper = list(drive.inputs.files), drive.mapper
    try:
        _locate(drive, files, thumbnails, vanished, checkpoint, session, stop)
    except InputError:
        # The cluster is lost; what it located is not.
        if mapper.frame_count and not vanished:
            resume.save(mapper, files, checkpoint)
        raise
    offset = ""
    if stop is None:
        _refuse_contradiction(drive, checkpoint)
        offset = feed_shifted(mapper, drive.telemetry) if drive.telemetry.find_time_offset else ""
        finish(mapper, files, session)
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
    stop_at: int | None,
) -> None:
    """Pass the frames through the mapper; note each file's digest, and the names that vanished."""
    mapper, schedule = drive.mapper, resume.SaveSchedule()
    if session.interruption.happened and mapper.frame_count:
        return
    missing = {file.index for file in files if not file.path.exists()}

    def note_vanished(prepared: PreparedFrame) -> None:
        file = files[prepared.index]
        if not prepared.digest and file.index not in missing and not file.path.exists():
            # Of the frames before it: a resumed run goes on with this one.
            if not vanished and mapper.frame_count:
                resume.save(mapper, files, checkpoint)
            vanished.append(file.name)

    for prepared in run_mapper(mapper, files, session, thumbnails, note_vanished, stop_at):
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
