"""The command line: ten-line commands, each of which calls one function of `slamcli.run`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from slamcli import __version__, options
from slamcli.core.errors import SlamcliError


class SlamGroup(click.Group):
    """The one boundary that turns an error into a line and an exit code."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; exit 1 with one line for an error that the user can mend."""
        try:
            return super().invoke(ctx)
        except SlamcliError as error:
            click.echo(f"Error: {error}", err=True)
            sys.exit(1)


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
@options.metres_per_pixel
@options.max_range
@click.option("--frame-rate", type=options.POSITIVE, help="Frames per second, for stamps.")
@click.option("--debug", is_flag=True, help="Also draw every frame's matches, into matches/.")
@options.workers
@options.seed
@options.overwrite
def stitch(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    workers: int | None,
    seed: int,
    overwrite: bool,
    **told: Any,
) -> None:
    """Stitch FRAMES (a folder, or image files) into one map, with poses and reasons."""
    from slamcli.core.config import MapperOptions, MatchOptions
    from slamcli.progress import ProgressBar
    from slamcli.run.executor import default_workers
    from slamcli.run.stitch import StitchOptions
    from slamcli.run.stitch import stitch as run_stitch

    resolved = StitchOptions(
        mapper=MapperOptions(matching=MatchOptions(seed=seed)),
        metres_per_pixel=told["metres_per_pixel"],
        max_range_metres=told["max_range"],
        frame_rate=told["frame_rate"],
        debug=told["debug"],
        workers=workers or default_workers(),
    )
    folder = output or default_output(frames[0], "mosaic")
    with ProgressBar() as progress:
        report = run_stitch(
            frames, calibration, folder, resolved, overwrite=overwrite, progress=progress
        )
    click.echo("\n".join(report.lines))
    sys.exit(report.exit_code)


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
    """Warp FRAMES to metric bird's-eye PNGs, each with a world file; the unseen is transparent."""
    from slamcli.progress import ProgressBar
    from slamcli.run.executor import default_workers
    from slamcli.run.warp import warp as run_warp

    with ProgressBar() as progress:
        lines = run_warp(
            frames,
            calibration,
            output or default_output(frames[0], "birdseye"),
            metres_per_pixel=metres_per_pixel,
            max_range_metres=max_range,
            workers=workers or default_workers(),
            overwrite=overwrite,
            progress=progress,
        )
    click.echo("\n".join(lines))


def default_output(source: Path, suffix: str) -> Path:
    """Return the folder beside the frames' own that results go to: frames -> frames_mosaic."""
    folder = source.resolve() if source.is_dir() else source.resolve().parent
    beside = folder.with_name(f"{folder.name}_{suffix}")
    return Path(os.path.relpath(beside)) if beside.is_relative_to(Path.cwd()) else beside
