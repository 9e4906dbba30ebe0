"""`slam detect`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from slamcli.cli.command import command
from slamcli.cli.messages import result
from slamcli.cli.options import common
from slamcli.cli.options.features import feature_details, feature_kind
from slamcli.cli.options.fields import filled
from slamcli.cli.options.selection import selection_options
from slamcli.core.config import FeatureOptions, FrameSelection, NetworkFiles


@command()
@common.frames
@common.calibration
@common.output(
    "Folder of the drawings and features.csv. Default: the frames' folder with _features added."
)
@feature_kind(FeatureOptions())
@feature_details
@selection_options
@common.json_output
@common.workers
@common.overwrite
def detect(
    frames: tuple[Path, ...],
    calibration: Path | None,
    output: Path | None,
    workers: int | None,
    as_json: bool,
    overwrite: bool,
    **flags: Any,
) -> None:
    """Draw the feature points found in frames.

    FRAMES is a folder, image files or a video. The drawings also show what is left out by --clean
    and --roi, and features.csv lists all points.
    """
    from slamcli.cli.progress import open_session
    from slamcli.run.detect import detect as run_detect

    with open_session(workers) as session:
        report = run_detect(
            frames,
            calibration,
            output or common.default_output(frames[0], "features"),
            filled(FeatureOptions(), flags),
            filled(NetworkFiles(), flags),
            selection=filled(FrameSelection(), flags),
            overwrite=overwrite,
            session=session,
        )
    result(report.json if as_json else "\n".join(report.lines))
