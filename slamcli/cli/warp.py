"""`slam warp`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.fields import filled
from slamcli.cli.options.selection import selection_options
from slamcli.core.config import FrameSelection, PaintOptions


@command()
@common.frames
@common.calibration
@common.output("Folder of the views. Default: the frames' folder with _birdseye added.")
@common.metres_per_pixel
@common.max_range
@selection_options
@common.json_output
@common.workers
@common.overwrite
def warp(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    max_range: float | None,
    workers: int | None,
    as_json: bool,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Warp frames to metric bird's-eye views.

    FRAMES is a folder, image files or a video. Each frame becomes a PNG with a world file (inverse
    perspective mapping), transparent where no floor is seen.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.warp import warp as run_warp

    with open_session(workers) as session:
        report = run_warp(
            frames,
            calibration,
            output or common.default_output(frames[0], "birdseye"),
            metres_per_pixel=filled(PaintOptions(), flags).metres_per_pixel,
            max_range_metres=max_range,
            selection=filled(FrameSelection(), flags),
            overwrite=overwrite,
            session=session,
        )
    result(report.json if as_json else "\n".join(report.lines))
