"""`slam calibrate`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import click

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.fields import filled, option, stacked
from slamcli.cli.options.values import PATH, POSITIVE, Gamma, Numbers
from slamcli.core.bounds import MAX_IMAGE_SIDE, Bounds

_target = partial(option, "CalibrateOptions")
_PIXEL = Bounds(-MAX_IMAGE_SIDE, 2 * MAX_IMAGE_SIDE)
_CORNERS = Bounds(3, 100, whole=True)

_target_options = stacked(
    click.option(
        "--side",
        type=POSITIVE,
        default=0.3048,
        show_default=True,
        help="Metres: side of the square, marker or field. A field is one of the chessboard.",
    ),
    _target(
        "corners",
        "--corners",
        Numbers("x,y x,y x,y x,y", 2, groups=4, limits=_PIXEL),
        "The square's corners, pixels. In any order; default: the square is detected.",
    ),
    click.option(
        "--refine/--no-refine",
        default=None,
        help="Move --corners to edges, or refine -c by frames. With --corners: to the edges "
        "nearby, by default where they are found; with -c: self-calibration by the frames of a "
        "drive, in place of photos.",
    ),
    common.calibration,
    _target(
        "chessboard",
        "--chessboard",
        Numbers("8x6", 2, separator="x", limits=_CORNERS),
        "Use a chessboard of this many inner corners. Along both sides; in place of a square.",
    ),
    _target("marker", "--aruco", text="Use an ArUco marker, of a dictionary like 4x4_50."),
    _target(
        "intrinsics_path",
        "--intrinsics",
        PATH,
        "The lens: a ROS camera_info YAML. Camera matrix and distortion.",
    ),
    _target(
        "ahead",
        "--ahead",
        click.Choice(["up", "right", "down", "left"]),
        "Direction in the picture that is ahead. Default: the optical axis, or up where the camera "
        "looks about straight down.",
    ),
    _target(
        "gamma",
        "--gamma",
        Gamma(),
        "How the photo encodes light. Edges lie where half of the light does.",
        default="srgb",
    ),
)


@command()
@click.argument("photos", nargs=-1, required=True, type=PATH)
@_target_options
@common.max_range
@common.output(
    "The calibration: .yaml, or a folder. Its check picture goes beside it.",
    default="calibration.yaml",
)
@common.json_output
@common.workers
@common.overwrite
def calibrate(
    photos: tuple[Path, ...],
    side: float,
    refine: bool | None,
    calibration: Path | None,
    max_range: float | None,
    output: Path,
    workers: int | None,
    as_json: bool,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Calibrate the camera from photos of a square on the floor.

    PHOTOS are image files; of several, the best calibration is chosen and all are compared. The
    result is the camera's focal length, height, pitch and roll. Or refine a calibration by the
    frames of a drive: --refine FRAMES -c CALIBRATION.
    """
    from slamcli.run.calibrate import CalibrateOptions
    from slamcli.run.calibrate import calibrate as run_calibrate

    if calibration is not None and not refine:
        raise click.UsageError("-c is for --refine, which refines a calibration by frames")
    if refine and (calibration is not None or any(photo.is_dir() for photo in photos)):
        from slamcli.cli.progress import open_session
        from slamcli.run.self_calibration import calibrate_by_frames

        with open_session(workers) as session:
            report = calibrate_by_frames(
                photos,
                calibration,
                output,
                max_range,
                overwrite=overwrite,
                session=session,
            )
    else:
        start = CalibrateOptions(side, refine=refine, max_range_metres=max_range)
        report = run_calibrate(photos, output, filled(start, flags), overwrite=overwrite)
    result(report.json if as_json else "\n".join(report.lines))
