"""`slam stitch`: frames in; a mosaic, poses and the pictures that explain them out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from slamcli import __version__
from slamcli.core.config import MapperOptions
from slamcli.core.errors import InputError
from slamcli.core.records import PoseEstimate
from slamcli.io.calibrations import save_calibration
from slamcli.io.checkpoints import Checkpoint, run_key
from slamcli.io.files import move_folder, output_folder, remove_folder
from slamcli.io.map_file import MAP_NAME, save_map
from slamcli.io.poses import write_poses
from slamcli.mapping.mapper import Mapper
from slamcli.run.calibrate.self_calibration import self_calibrate
from slamcli.run.frame_loop import finish, registration_of, walk
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.networks import with_match_network, with_point_network
from slamcli.run.paint import outputs
from slamcli.run.paint.paint import scenes_of
from slamcli.run.paint.thumbnails import Thumbnails
from slamcli.run.session.executor import Progress
from slamcli.run.session.interruption import Interruption, interruptible
from slamcli.run.stitch import exports, report
from slamcli.run.stitch.debug_drawings import draw_trials
from slamcli.run.stitch.extend import open_extension
from slamcli.run.stitch.options import StitchOptions
from slamcli.run.stitch.report import StitchReport
from slamcli.run.telemetry import Telemetry, TelemetryFiles, feed, feed_shifted, read_telemetry

PRODUCTS = (
    "poses.csv",
    "run.toml",
    "calibration.yaml",
    MAP_NAME,
    *outputs.PRODUCTS,
    *exports.PRODUCTS,
)
DEBUG_PRODUCTS = "matches"
# A state is kept so often, and takes at most this share of the time.
_SAVE_SECONDS, _SAVE_SHARE = 5.0, 0.05


def stitch(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    options: StitchOptions,
    *,
    telemetry: TelemetryFiles | None = None,
    overwrite: bool,
    progress: Progress,
    tell: Callable[[str], None],
) -> StitchReport:
    """Map the frames of folders or files into `output`.

    Raises
    ------
    InputError, CalibrationError, OutputError
    """
    started = time.monotonic()
    files = telemetry or TelemetryFiles()
    extended = None
    if options.extend is not None:
        _check_alone(options, calibration_path, files)
        extended = open_extension(options.extend, sources, options.frame_rate)
        inputs, sources = extended.inputs, extended.sources
        options = replace(options, mapper=extended.options(options.mapper))
    else:
        inputs = open_inputs(
            sources, calibration_path, options.frame_rate, options.max_range_metres
        )
    if options.scheduler:
        # Workers stand in folders of their own.
        found_at = [replace(file, path=file.path.resolve()) for file in inputs.files]
        inputs = replace(inputs, files=found_at)
    readings = read_telemetry(files, inputs)
    exports.check_exports(options.export, inputs.files, has_gps=bool(readings.gps))
    outputs.check_formats(options.products)
    if options.self_calibrate and (files.odometry or files.compass or files.gps):
        raise InputError(
            "--self-calibrate works by the frames alone; refine the camera first "
            "(slam calibrate --refine), then give what comes of it with the other senses"
        )
    new = Mapper(inputs.calibration, _with_networks(options), options.telemetry)
    if extended is not None:
        new.extend(extended.floor_map)
    if not readings.find_time_offset:
        feed(new, readings)
    patterns = (*PRODUCTS, DEBUG_PRODUCTS)
    with (
        interruptible() as interruption,
        Checkpoint(output) as checkpoint,
        output_folder(output, patterns, overwrite=overwrite, resume=options.resume) as staging,
    ):
        mapper = _begin(new, inputs, options, files, checkpoint, tell)
        thumbnails = Thumbnails()
        note = _locate(
            mapper, inputs, options, readings, checkpoint, progress, interruption, thumbnails
        )
        found, refined = registration_of(mapper), None
        if options.self_calibrate and not interruption.happened:
            resolved = mapper.options
            refined = self_calibrate(inputs, found, resolved, options.workers, progress)
            found = refined.registration
            inputs = replace(inputs, calibration=found.calibration)
            save_calibration(staging / "calibration.yaml", found.calibration)
        estimates = [*found.estimates, *_not_reached(inputs, mapper)]
        scenes = scenes_of(
            inputs.calibration,
            estimates,
            lambda estimate: inputs.files[estimate.index],
            options.products.turn_radians,
            thumbnails,
        )
        # Tiles of poses that more frames would change are of no use to a run that goes on.
        unfinished = staging / "tiles"
        area = outputs.write_maps(
            scenes,
            options.products,
            exports.datums(mapper),
            staging,
            unfinished if interruption.happened else checkpoint.tiles,
            options.workers,
            progress,
            tell,
            interruption,
            options.scheduler,
        )
        remove_folder(unfinished)
        write_poses(staging / "poses.csv", estimates)
        if found.floor_map is not None:
            save_map(staging / MAP_NAME, replace(found.floor_map, sources=tuple(sources)))
        seconds = time.monotonic() - started
        exports.write_exports(staging, options.export, found, mapper)
        report.write_run(
            staging / "run.toml", sources, inputs, options, files, estimates, mapper, refined
        )
        move_folder(checkpoint.drawings, staging / DEBUG_PRODUCTS)
        if interruption.happened:
            checkpoint.keep()
    return report.report(
        inputs,
        estimates,
        mapper,
        area,
        seconds,
        output,
        note,
        refined,
        interrupted=interruption.happened,
    )


def _check_alone(
    options: StitchOptions, calibration_path: Path | None, files: TelemetryFiles
) -> None:
    """Refuse what a finished map cannot be gone on with."""
    if calibration_path is not None or options.max_range_metres is not None:
        raise InputError("--extend goes on with the map's own camera; leave out -c and --max-range")
    if options.self_calibrate or files.odometry or files.compass or files.gps:
        raise InputError(
            "--extend works by the frames alone, with the camera as it is; leave out "
            "--self-calibrate, --odometry, --compass and --gps, or stitch both drives anew"
        )


def _begin(
    new: Mapper,
    inputs: Inputs,
    options: StitchOptions,
    files: TelemetryFiles,
    checkpoint: Checkpoint,
    tell: Callable[[str], None],
) -> Mapper:
    """Return the new mapper, or that of a run that was cut off."""
    total = len(inputs.files)
    paths = [file.path for file in inputs.files]
    others = (inputs.calibration_path, files.odometry, files.compass, files.gps)
    paths += [path for path in others if path is not None]
    plain = replace(options, resume=False, workers=1, scheduler="")
    if checkpoint.open(run_key(f"{__version__} {plain!r}", paths), resume=options.resume):
        mapper = checkpoint.load()
        if isinstance(mapper, Mapper):
            tell(f"resumed: {len(mapper.estimates)} of {total} frames had been located")
            return mapper
    elif options.resume:
        tell("nothing to resume: no run of these frames and options was cut off; starting anew")
    return new


def _with_networks(options: StitchOptions) -> MapperOptions:
    told, files = options.mapper, options.networks
    method = told.features.method
    return replace(
        told,
        features=with_point_network(told.features, files, method),
        matching=with_match_network(told.matching, files, method),
    )


def _locate(
    mapper: Mapper,
    inputs: Inputs,
    options: StitchOptions,
    readings: Telemetry,
    checkpoint: Checkpoint,
    progress: Progress,
    interruption: Interruption,
    thumbnails: Thumbnails,
) -> str:
    """First walk: every frame to its pose or its reason; those that a mapper has seen are done.

    Returns the clocks' offset, in words, if it was to be found.
    """
    pace, total = _SaveSchedule(), len(inputs.files)
    workers, scheduler = options.workers, options.scheduler
    for done in walk(mapper, inputs.files, workers, progress, scheduler, thumbnails):
        if options.debug:
            draw_trials(mapper.trials, checkpoint.drawings)
        stop = interruption.heeded()
        if stop or pace.due() or done == total:
            pace.saving(lambda: checkpoint.save(mapper))
        if stop:
            break
    note = feed_shifted(mapper, readings) if readings.find_time_offset else ""
    finish(mapper, options.workers)
    return note


def _not_reached(inputs: Inputs, mapper: Mapper) -> list[PoseEstimate]:
    """Return the frames that an interrupted run has not come to."""
    reason = "not reached: interrupted"
    return [
        PoseEstimate(file.index, file.name, file.stamp, None, "lost", reason)
        for file in inputs.files[len(mapper.estimates) :]
    ]


class _SaveSchedule:
    """When to save a state next: not before long, and never for more than a share of the time."""

    def __init__(self) -> None:
        self._wait, self._last = _SAVE_SECONDS, time.monotonic()

    def due(self) -> bool:
        return time.monotonic() - self._last >= self._wait

    def saving(self, save: Callable[[], None]) -> None:
        started = time.monotonic()
        save()
        self._last = time.monotonic()
        self._wait = max(_SAVE_SECONDS, (self._last - started) / _SAVE_SHARE)
