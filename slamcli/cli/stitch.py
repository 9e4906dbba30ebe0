"""`slam stitch`."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.options import common
from slamcli.cli.options.features import feature_details
from slamcli.cli.options.fields import filled, option, stacked
from slamcli.cli.options.mapping import mapper_options
from slamcli.cli.options.matching import matching_details, ratio
from slamcli.cli.options.products import product_options
from slamcli.cli.options.repeating import repeating
from slamcli.cli.options.selection import selection_options
from slamcli.cli.options.telemetry import telemetry_options
from slamcli.cli.options.values import PATH, POSITIVE, Number, Words
from slamcli.core.bounds import HERTZ
from slamcli.core.config import MapperOptions, MatchOptions
from slamcli.core.telemetry import TelemetryOptions

if TYPE_CHECKING:
    from slamcli.run.stitch.options import StitchOptions

_stitch = partial(option, "StitchOptions")

_frame_options = stacked(
    _stitch(
        "frame_rate",
        "--frame-rate",
        Number(HERTZ),
        "Frames per second, which give the frames their stamps.",
    ),
    _stitch(
        "mount",
        "--mount",
        click.Choice(["auto", "rigid", "free"]),
        "How a camera without a calibration is carried: rigid, always at one height and straight "
        "down; free, with height and tilt that vary; auto finds out.",
        default="auto",
    ),
    _stitch(
        "height_metres",
        "--height",
        POSITIVE,
        "Metres: height of a camera without a calibration that looks ahead, which gives its map "
        "the scale.",
    ),
    _stitch("debug", "--debug", text="Also draw every frame's matches, in matches/.", is_flag=True),
    _stitch(
        "export",
        "--export",
        Words("tum", "kitti", "g2o", "links", "geojson"),
        "Also write, separated by commas: tum, kitti (trajectories), g2o (the pose graph), links "
        "(its edges, as a table), geojson (the trajectory on Earth, with --gps).",
        default="",
    ),
)

_run_options = stacked(
    click.option(
        "--dry-run",
        is_flag=True,
        help="Only check the frames for faults and estimate the time, memory and disk of a run.",
    ),
    _stitch(
        "extend",
        "--extend",
        PATH,
        "Add FRAMES, of a later drive, to a finished map: the output of slam stitch.",
        metavar="MAP",
    ),
    _stitch(
        "resume",
        "--resume",
        text="Continue an interrupted run of the same frames and options.",
        is_flag=True,
    ),
    _stitch("strict", "--strict", text="Exit 3 when any frame is lost.", is_flag=True),
    _stitch(
        "self_calibrate",
        "--self-calibrate/--no-self-calibrate",
        text="Self-calibration: refine the camera, and the tilt and height of every frame, by the "
        "frames themselves, as far as they determine them.",
        default=False,
    ),
)


@click.command()
@common.frames
@common.calibration
@common.output("Folder of the map. Default: the frames' folder with _mosaic added.")
@product_options
@common.max_range
@selection_options
@_frame_options
@telemetry_options
@_run_options
@mapper_options
@feature_details
@matching_details(ratio(MatchOptions()))
@common.workers
@common.scheduler
@common.overwrite
def stitch(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    workers: int | None,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Stitch the frames of a drive into one map of the floor.

    FRAMES is a folder, image files, in the order they were taken, or a video. The output is a
    folder with the map (an orthomosaic: metric, seen from above, with a world file) and poses.csv,
    which has for every frame its pose, or the reason why it has none.
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
    click.echo("\n".join(report.lines))
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
    click.echo("\n".join(lines))
