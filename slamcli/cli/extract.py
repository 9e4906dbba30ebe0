"""`slam extract`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.fields import filled
from slamcli.cli.options.selection import selection_options
from slamcli.core.config import FrameSelection


@command()
@common.frames
@common.output("Folder of the files. Default: that of the source with _extracted added.")
@selection_options
@common.json_output
@common.workers
@common.overwrite
def extract(
    frames: tuple[Path, ...],
    output: Path | None,
    as_json: bool,
    workers: int | None,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Write the frames and readings of a video or bag as files.

    FRAMES is a video, a ROS 1 or 2 bag, or whatever else `slam stitch` takes. The output is a
    folder with the frames, named by their stamps, and of a bag also camera_info.yaml, odometry.csv,
    gps.csv and compass.csv, as the other commands read them.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.extract import extract as run_extract

    with open_session(workers) as session:
        report = run_extract(
            frames,
            output or common.default_output(frames[0], "extracted"),
            selection=filled(FrameSelection(), flags),
            overwrite=overwrite,
            session=session,
        )
    result(report.json if as_json else "\n".join(report.lines))
