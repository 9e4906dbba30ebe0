"""`slam stitch`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.features import feature_details
from slamcli.cli.options.fields import filled, option
from slamcli.cli.options.mapping import mapper_options
from slamcli.cli.options.matching import matching_details, ratio
from slamcli.cli.options.products import product_options
from slamcli.cli.options.repeating import repeating
from slamcli.cli.options.sections import CAMERA, ESSENTIAL, OUTPUT, expert, section
from slamcli.cli.options.selection import selection_options
from slamcli.cli.options.telemetry import telemetry_options
from slamcli.cli.options.values import PATH, POSITIVE, Bar, Number, Switch, Words
from slamcli.core.bounds import HERTZ
from slamcli.core.config import MapperOptions, MatchOptions
from slamcli.core.telemetry import TelemetryOptions

if TYPE_CHECKING:
    from slamcli.run.stitch.options import StitchOptions

_stitch = partial(option, "StitchOptions")

_camera = section(
    CAMERA,
    _stitch(
        "frame_rate",
        "--frame-rate",
        Number(HERTZ),
        "Frames per second, for stamps.",
    ),
    expert(
        CAMERA,
        _stitch(
            "mount",
            "--mount",
            click.Choice(["auto", "rigid", "gimbal", "hand"]),
            "How the camera is carried: rigid, as on a robot (without a calibration: at one height "
            "and straight down); gimbal, with a height that varies; hand, with a height and a tilt "
            "that vary; auto finds out.",
            default="auto",
        ),
    ),
    _stitch(
        "height_metres",
        "--height",
        POSITIVE,
        "Metres above the floor, without a calibration. It gives the map its scale.",
    ),
    expert(
        CAMERA,
        _stitch(
            "unordered",
            "--unordered",
            text="The frames come in no order. Those that overlap are found by appearance alone; "
            "by itself where tracking from frame to frame leaves most apart.",
            is_flag=True,
        ),
        _stitch(
            "intrinsics_path",
            "--intrinsics",
            PATH,
            "The lens, without a calibration: a ROS camera_info YAML. Of a camera that moves "
            "freely, or whose mounting the frames are to show.",
        ),
        _stitch(
            "scale",
            "--scale",
            Bar(),
            "Two pixels of a frame and their metres, without a calibration. Of frames from above: "
            "the frame's name, column and row of either end, and their distance.",
        ),
        _stitch(
            "control",
            "--control",
            PATH,
            "CSV of control points, without a calibration. Columns frame, column, row, and x, y "
            "(metres) or latitude, longitude; of frames from above.",
        ),
    ),
    _stitch(
        "self_calibrate",
        "--self-calibrate",
        Switch(),
        "Refine the camera by the frames themselves. And every frame's tilt and height, as far as "
        "they determine them (self-calibration); auto: where they contradict the calibration; the "
        "flag alone: always.",
        default="auto",
    ),
)

_results = section(
    OUTPUT,
    _stitch(
        "export",
        "--export",
        Words("tum", "kitti", "g2o", "links", "geojson"),
        "Also write tum, kitti, g2o, links or geojson. Separated by commas: tum, kitti "
        "(trajectories), g2o (the pose graph), links (its edges, as a table), geojson (the "
        "trajectory on Earth, with --gps).",
        default="",
    ),
    expert(
        OUTPUT,
        _stitch(
            "debug", "--debug", text="Also draw every frame's matches, in matches/.", is_flag=True
        ),
    ),
    _stitch(
        "strict",
        "--strict",
        text="Exit 3 when any frame is lost. Without it only when most are.",
        is_flag=True,
    ),
)

_run_options = section(
    ESSENTIAL,
    click.option(
        "--dry-run",
        is_flag=True,
        help="Only check the frames; estimate time and disk. Lists their faults, and what memory "
        "a run would take.",
    ),
    _stitch(
        "extend",
        "--extend",
        PATH,
        "Add FRAMES to a finished map. Those of a later drive, to the output of slam stitch.",
        metavar="MAP",
    ),
    _stitch(
        "resume",
        "--resume",
        text="Continue an interrupted run. The same frames and options must be given.",
        is_flag=True,
    ),
)


@command()
@common.frames
@common.calibration
@common.output("Folder of the map. Default: the frames' folder with _mosaic added.")
@common.overwrite
@_run_options
@_camera
@selection_options
@expert(CAMERA, common.max_range)
@telemetry_options
@product_options
@_results
@common.json_output
@mapper_options
@feature_details
@matching_details(ratio(MatchOptions()))
@common.workers
@common.scheduler
def stitch(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    workers: int | None,
    as_json: bool,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Stitch the frames of a drive into one map of the floor.

    FRAMES is a folder, image files, in the order they were taken, or a video. The output is a
    folder with the map (an orthomosaic) and poses.csv: every frame's pose, or why it has none.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.stitch import stitch as run_stitch
    from slamcli.run.stitch.options import StitchOptions
    from slamcli.run.telemetry import TelemetryFiles

    offset = flags["time_offset"]
    start = StitchOptions(
        MapperOptions(),
        TelemetryOptions(time_offset_seconds=offset[0] if offset else 0.0),
        max_range_metres=flags["max_range"],
    )
    resolved = filled(start, flags)
    if flags["dry_run"]:
        _dry_run(frames, calibration, resolved, workers)
        return
    with open_session(workers, flags["scheduler"]) as session:
        report = run_stitch(
            frames,
            calibration,
            output or common.default_output(frames[0], "mosaic"),
            resolved,
            telemetry=filled(TelemetryFiles(find_time_offset=offset is None), flags),
            overwrite=overwrite,
            session=session,
            command=repeating(click.get_current_context()),
        )
    result(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)


def _dry_run(
    frames: tuple[Path, ...],
    calibration: Path | None,
    options: StitchOptions,
    workers: int | None,
) -> None:
    """Print the faults of the frames and what a run will take."""
    from slamcli.cli.progress import open_session
    from slamcli.run.stitch.dry_run import forecast

    if options.extend:
        raise click.UsageError("--dry-run does not take --extend")
    with open_session(workers) as session:
        lines = forecast(frames, calibration, options, session=session)
    result("\n".join(lines))
