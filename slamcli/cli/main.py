"""The command line: ten-line commands, each of which calls one function of `slamcli.run`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli import __version__
from slamcli.cli import options
from slamcli.core.errors import SlamcliError
from slamcli.core.exit_codes import ExitCode

if TYPE_CHECKING:
    from slamcli.simulation.config import SimulationOptions


class SlamGroup(click.Group):
    """The one boundary that turns an error into a line and an exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn an error of the user's into one line and an exit code."""
        try:
            return super().invoke(ctx)
        except SlamcliError as error:
            click.echo(f"Error: {error}", err=True)
            sys.exit(ExitCode.ERROR)
        except KeyboardInterrupt:
            click.echo("interrupted", err=True)
            sys.exit(ExitCode.INTERRUPTED)


class Numbers(click.ParamType[tuple[tuple[float, float], ...]]):
    """So many pairs of numbers, such as "12,34 56,78" or 8x6."""

    def __init__(self, pairs: int, separator: str, name: str) -> None:
        self.pairs, self.separator, self.name = pairs, separator, name

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[tuple[float, float], ...]:
        """Return the pairs; a usage error says what form is wanted."""
        try:
            pairs = [tuple(map(float, pair.split(self.separator))) for pair in value.split()]
        except ValueError:
            pairs = []
        if len(pairs) != self.pairs or any(len(pair) != 2 for pair in pairs):
            self.fail(f"{value!r} is not of the form {self.name}", param, ctx)
        return tuple((pair[0], pair[1]) for pair in pairs)


@click.group(cls=SlamGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, package_name="slamcli", prog_name="slam")
def main() -> None:
    """Turn what a robot's camera saw of the floor into one metric map."""
    # A frame that cannot be decoded is told of once, as its reason; OpenCV would tell it again.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")


@main.command()
@options.frames
@options.calibration
@options.output("the map (default: the folder's name with _mosaic)")
@options.product_options
@options.max_range
@click.option("--frame-rate", type=options.POSITIVE, help="Frames per second, for stamps.")
@click.option("--debug", is_flag=True, help="Also draw every frame's matches, into matches/.")
@click.option(
    "--export",
    type=options.Choices(("tum", "kitti", "g2o", "links", "geojson")),
    default="",
    help="Also write, separated by commas: tum, kitti (trajectories), g2o (the pose graph), links "
    "(a table of them), geojson (the track on Earth, with --gps).",
)
@options.telemetry_options
@click.option(
    "--dry-run",
    is_flag=True,
    help="Only look for faults in the frames and tell what mapping them will take.",
)
@click.option(
    "--extend",
    type=options.PATH,
    metavar="MAP",
    help="Add FRAMES, of a later drive, to a finished map: the output of slam stitch.",
)
@click.option(
    "--resume", is_flag=True, help="Go on with a run of the same frames and options, cut off."
)
@options.strict
@options.self_calibrate
@options.mapper_options
@options.feature_details
@options.match_details
@options.workers
@options.scheduler
@options.overwrite
def stitch(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    workers: int | None,
    overwrite: bool,
    **told: Any,
) -> None:
    """Stitch FRAMES into one map.

    FRAMES is a folder or image files. Each one gets a pose, or the reason why it has none.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.stitch import stitch as run_stitch
    from slamcli.run.stitch.options import StitchOptions
    from slamcli.run.telemetry import TelemetryFiles

    resolved = StitchOptions(
        mapper=options.mapper_of(told),
        telemetry=options.telemetry_of(told),
        networks=options.networks_of(told),
        products=options.products_of(told),
        max_range_metres=told["max_range"],
        frame_rate=told["frame_rate"],
        debug=told["debug"],
        self_calibrate=told["self_calibrate"],
        export=told["export"],
        extend=told["extend"],
        resume=told["resume"],
        strict=told["strict"],
    )
    if told["dry_run"] and told["extend"]:
        raise click.UsageError("--dry-run does not take --extend")
    if told["dry_run"]:
        from slamcli.run.stitch.dry_run import forecast

        with open_session(workers) as session:
            lines = forecast(frames, calibration, resolved, session=session)
        click.echo("\n".join(lines))
        return
    folder = output or default_output(frames[0], "mosaic")
    with open_session(workers, told["scheduler"]) as session:
        report = run_stitch(
            frames,
            calibration,
            folder,
            resolved,
            telemetry=TelemetryFiles(
                told["odometry"], told["compass"], told["gps"], told["time_offset"] is None
            ),
            overwrite=overwrite,
            session=session,
        )
    click.echo("\n".join(report.lines))
    sys.exit(report.exit_code)


@main.command()
@click.argument("floor_map", metavar="MAP", type=options.PATH)
@options.frames
@options.output("the poses, as CSV")
@click.option("--json", "as_json", is_flag=True, help="Print everything measured, as JSON.")
@options.strict
@options.workers
@options.overwrite
def locate(
    floor_map: Path,
    frames: tuple[Path, ...],
    output: Path | None,
    as_json: bool,
    strict: bool,
    workers: int | None,
    overwrite: bool,
) -> None:
    """Find FRAMES in a finished MAP.

    MAP is a folder that `slam stitch` wrote, or the map.slam in it. Each frame is looked up by
    itself; exit 1 when none of them is there, 3 when most are not.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.locate import locate as run_locate

    with open_session(workers) as session:
        report = run_locate(
            floor_map,
            frames,
            output,
            overwrite=overwrite,
            strict=strict,
            session=session,
        )
    click.echo(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)


@main.command()
@click.argument("run", type=options.PATH)
@options.output("the map (default: RUN's name with _render)")
@options.product_options
@click.option(
    "--frames", "frames", type=options.PATH, help="Where the frames are now, if they were moved."
)
@options.workers
@options.overwrite
def render(
    run: Path,
    output: Path | None,
    frames: Path | None,
    workers: int | None,
    overwrite: bool,
    **told: Any,
) -> None:
    """Paint the map of RUN again, otherwise.

    RUN is the output of slam stitch; no frame is located anew.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.render import render as run_render

    with open_session(workers) as session:
        lines = run_render(
            run,
            frames,
            output or default_output(run, "render"),
            options.products_of(told),
            overwrite=overwrite,
            session=session,
        )
    click.echo("\n".join(lines))


@main.command()
@options.frames
@options.calibration
@options.output("the bird's-eye pictures (default: the folder's name with _birdseye)")
@options.metres_per_pixel
@options.max_range
@options.workers
@options.overwrite
def warp(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    metres_per_pixel: float | None,
    max_range: float | None,
    workers: int | None,
    overwrite: bool,
) -> None:
    """Warp FRAMES to metric bird's-eye pictures.

    Each is a PNG, transparent where no floor was seen, with a world file.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.warp import warp as run_warp

    with open_session(workers) as session:
        lines = run_warp(
            frames,
            calibration,
            output or default_output(frames[0], "birdseye"),
            metres_per_pixel=metres_per_pixel,
            max_range_metres=max_range,
            overwrite=overwrite,
            session=session,
        )
    click.echo("\n".join(lines))


@main.command()
@options.frames
@options.calibration
@options.output("the drawings and features.csv (default: the folder's name with _features)")
@click.option("--features", type=click.Choice(options.FEATURES), default="orb", show_default=True)
@click.option("--count", type=click.IntRange(min=1), default=500, show_default=True)
@options.feature_details
@options.workers
@options.overwrite
def detect(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    features: Any,
    workers: int | None,
    overwrite: bool,
    **told: Any,
) -> None:
    """Draw the points found in FRAMES.

    Also what cleaning and the region of interest removed, and a table of the points.
    """
    from slamcli.cli.progress import open_session
    from slamcli.core.config import FeatureOptions
    from slamcli.run.detect import detect as run_detect

    with open_session(workers) as session:
        lines = run_detect(
            frames,
            calibration,
            output or default_output(frames[0], "features"),
            options.picked(FeatureOptions, {**told, "method": features}),
            options.networks_of(told),
            overwrite=overwrite,
            session=session,
        )
    click.echo("\n".join(lines))


@main.command()
@click.argument("first", type=options.PATH)
@click.argument("second", type=options.PATH)
@options.calibration
@options.output("a drawing of the matches")
@click.option(
    "--model",
    type=click.Choice(["rigid", "similarity", "affine", "homography"]),
    help="Default: rigid with a calibration, else similarity.",
)
@click.option(
    "--features",
    type=click.Choice(["auto", *options.FEATURES]),
    default="auto",
    show_default=True,
    help="auto tries ORB and SIFT, on the pictures as they are and enlarged, and believes fewer "
    "inliers where the pixels confirm them.",
)
@click.option(
    "--count", type=click.IntRange(min=1), help="Most features. Default: 500, or what auto takes."
)
@options.feature_details
@options.match_details
@click.option("--json", "as_json", is_flag=True, help="Print everything measured, as JSON.")
@options.overwrite
def match(
    first: Path,
    second: Path,
    calibration: Path | None,
    output: Path | None,
    model: Any,
    features: Any,
    count: int | None,
    ratio: float | None,
    as_json: bool,
    overwrite: bool,
    **told: Any,
) -> None:
    """Find the transform from FIRST to SECOND.

    Or say why nothing fits (exit 1).
    """
    from slamcli.core.config import FeatureOptions, MatchOptions
    from slamcli.run.match import PairOptions
    from slamcli.run.match import match as run_match

    resolved = PairOptions(
        options.picked(FeatureOptions, told),
        options.picked(MatchOptions, told),
        features,
        count,
        model,
        ratio,
        options.networks_of(told),
    )
    report = run_match(first, second, calibration, output, resolved, overwrite=overwrite)
    click.echo(report.json if as_json else "\n".join(report.lines))
    sys.exit(report.exit_code)


@main.command()
@click.argument("poses", type=options.PATH)
@click.argument("truth", type=options.PATH)
@click.option(
    "--tolerance",
    type=options.NOT_NEGATIVE,
    default=0.01,
    show_default=True,
    help="Seconds by which the stamps of one moment may differ.",
)
@click.option(
    "--delta",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Poses over which the relative error (RPE) is taken.",
)
@click.option("--json", "as_json", is_flag=True, help="Print everything measured, as JSON.")
def evaluate(poses: Path, truth: Path, tolerance: float, delta: int, as_json: bool) -> None:
    """Measure how far POSES are from the TRUTH.

    Both are poses.csv, truth.csv, TUM or KITTI, matched by stamps, else by frame names.
    """
    from slamcli.run.evaluate import evaluate as run_evaluate

    report = run_evaluate(poses, truth, tolerance_seconds=tolerance, delta=delta)
    click.echo(report.json if as_json else "\n".join(report.lines))


@main.command()
@click.argument("photos", nargs=-1, required=True, type=options.PATH)
@click.option(
    "--side",
    type=float,
    default=0.3048,
    show_default=True,
    help="Metres: side of the square or the marker, or of one field of the chessboard.",
)
@click.option(
    "--corners",
    type=Numbers(4, ",", "x,y x,y x,y x,y"),
    help="The square's corners in pixels, any order. Default: it is found.",
)
@click.option(
    "--refine",
    is_flag=True,
    help="With --corners: move them to the edges nearby. With -c: refine that calibration by the "
    "frames of a drive, which are given in place of photos.",
)
@options.calibration
@click.option(
    "--chessboard",
    type=Numbers(1, "x", "8x6"),
    help="A chessboard instead, by its inner corners along both sides.",
)
@click.option("--aruco", help="An ArUco marker instead, by its dictionary, such as 4x4_50.")
@click.option("--intrinsics", type=options.PATH, help="The lens: a ROS camera_info YAML.")
@options.max_range
@options.output(
    "the calibration (.yaml, or a folder) and its check picture", default="calibration.yaml"
)
@options.workers
@options.overwrite
def calibrate(
    photos: tuple[Path, ...],
    side: float,
    corners: Any,
    refine: bool,
    calibration: Path | None,
    chessboard: Any,
    aruco: str | None,
    intrinsics: Path | None,
    max_range: float | None,
    output: Path,
    workers: int | None,
    overwrite: bool,
) -> None:
    """Calibrate from PHOTOS of a square.

    The square lies on the floor. Several photos are compared and the best is named. Or refine a
    calibration by a drive: --refine FRAMES -c CALIBRATION.
    """
    from slamcli.run.calibrate import CalibrateOptions
    from slamcli.run.calibrate import calibrate as run_calibrate

    if calibration is not None and not refine:
        raise click.UsageError("-c is for --refine, which refines a calibration by frames")
    if refine and (calibration is not None or any(photo.is_dir() for photo in photos)):
        from slamcli.cli.progress import open_session
        from slamcli.run.calibrate.self_calibration import calibrate_by_frames

        with open_session(workers) as session:
            lines = calibrate_by_frames(
                photos,
                calibration,
                output,
                max_range,
                overwrite=overwrite,
                session=session,
            )
        click.echo("\n".join(lines))
        return

    resolved = CalibrateOptions(
        side_metres=side,
        corners=corners,
        refine=refine,
        chessboard=chessboard[0] if chessboard else None,
        marker=aruco,
        intrinsics_path=intrinsics,
        max_range_metres=max_range,
    )
    click.echo("\n".join(run_calibrate(photos, output, resolved, overwrite=overwrite)))


@main.command()
@click.argument("output", type=options.PATH)
@options.floor_options
@options.path_options
@options.camera_options
@options.disturbance_options
@click.option(
    "--square-side",
    type=options.POSITIVE,
    default=0.3048,
    show_default=True,
    help="Metres; of the square in square.png.",
)
@click.option("--jpeg-quality", type=click.IntRange(1, 100), default=92, show_default=True)
@options.workers
@options.seed
@options.overwrite
def simulate(output: Path, workers: int | None, overwrite: bool, **told: Any) -> None:
    """Simulate a drive over a floor into OUTPUT.

    Frames, a calibration photo, exact truth, odometry, compass and GPS.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.simulate import simulate as run_simulate

    with open_session(workers) as session:
        lines = run_simulate(
            output,
            simulation_of(told),
            overwrite=overwrite,
            session=session,
        )
    click.echo("\n".join(lines))


def simulation_of(told: dict[str, Any]) -> SimulationOptions:
    """Return what the flags of `slam simulate` ask for."""
    from slamcli.simulation.config import CameraOptions, DisturbanceOptions, SimulationOptions

    return SimulationOptions(
        floor=told["floor"],
        floor_metres_per_pixel=told["floor_metres_per_pixel"],
        wear=told["wear"],
        room_metres=told["room"],
        path=told["path"],
        length_metres=told["length"],
        frames=told["frames"],
        frame_rate_hertz=told["frame_rate"],
        lane_metres=told["lane"],
        square_side_metres=told["square_side"],
        jpeg_quality=told["jpeg_quality"],
        camera=CameraOptions(
            size=told["size"],
            height_metres=told["height"],
            pitch_degrees=told["pitch"],
            roll_degrees=told["roll"],
            field_of_view_degrees=told["field_of_view"],
            k1=told["k1"],
            k2=told["k2"],
        ),
        disturbances=DisturbanceOptions(
            noise_gray=told["noise"],
            motion_blur=told["motion_blur"],
            flicker=told["flicker"],
            vignetting=told["vignetting"],
            rocking_degrees=told["rocking"],
            bounce_metres=told["bounce"],
            boxes=told["boxes"],
            walkers=told["walkers"],
        ),
        seed=told["seed"],
    )


def default_output(source: Path, suffix: str) -> Path:
    """Return the folder beside the frames' own that results go to: frames -> frames_mosaic."""
    folder = source.resolve() if source.is_dir() else source.resolve().parent
    beside = folder.with_name(f"{folder.name}_{suffix}")
    return Path(os.path.relpath(beside)) if beside.is_relative_to(Path.cwd()) else beside
