"""`slam detect`: the points found in every frame, drawn and in one table."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from slamcli.core.arrays import BoolArray
from slamcli.core.camera.calibration import Calibration
from slamcli.core.config import FeatureOptions, FrameSelection
from slamcli.core.records import Features, Keypoints, View
from slamcli.drawing.keypoints import draw_keypoints
from slamcli.io.files import write_drawing
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.keypoints import write_keypoints
from slamcli.run.command_report import Report
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.match.fitting import plain_picture
from slamcli.run.networks import NetworkFiles, with_point_network
from slamcli.run.per_frame import Skipped, each_frame, frame_outputs
from slamcli.run.session.session import Session
from slamcli.stages import features, view
from slamcli.stages.view import Resampler

TABLE = "features.csv"
SUFFIX = "_keypoints.png"


def detect(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    options: FeatureOptions,
    networks: NetworkFiles,
    *,
    selection: FrameSelection | None = None,
    overwrite: bool,
    session: Session,
) -> Report:
    """Write one drawing a frame and `features.csv` into `output`.

    Raises
    ------
    InputError, CalibrationError, OutputError
        InputError also when no frame at all can be searched.
    """
    inputs = open_inputs(sources, calibration_path, selection=selection, progress=session.progress)
    options = with_point_network(options, networks, options.method)
    resampler = _resampler(inputs)
    read = (*inputs.paths, *networks.paths)
    with frame_outputs(
        inputs.files, output, (SUFFIX,), TABLE, inputs=read, overwrite=overwrite
    ) as staging:
        work = partial(_search, inputs.calibration, resampler, options, staging)
        results = each_frame("detecting", work, inputs.files, session)
        found = [result for result in results if not isinstance(result, Skipped)]
        write_keypoints(staging / TABLE, found, inputs.calibration.unit)
    lines = [
        *([inputs.note] if inputs.note else []),
        *(
            f"skipped {result.reason}"
            if isinstance(result, Skipped)
            else f"{result[0]}: {len(result[1])} {options.method.upper()} points"
            for result in results
        ),
        f"drawings and {TABLE} in {output}",
    ]
    facts = {
        "frames": len(inputs.files),
        "points": {name: len(points) for name, points, _ in found},
        "skipped": [result.reason for result in results if isinstance(result, Skipped)],
        "features": options.method,
        "output": output,
    }
    return Report(tuple(lines), facts)


def _resampler(inputs: Inputs) -> Resampler | None:
    """Return the resampler of bird's-eye views; None for plain pictures, whose sizes may differ."""
    if inputs.calibration_path is None:
        return None
    scale = view.registration_metres_per_pixel(inputs.calibration)
    return view.make_view_resampler(inputs.calibration, scale)


def _search(
    calibration: Calibration,
    resampler: Resampler | None,
    options: FeatureOptions,
    staging: Path,
    file: FrameFile,
) -> tuple[str, Keypoints, Features]:
    """Draw one frame's points; return its name and them. Raises FrameError."""
    frame = read_frame(file)
    if resampler is None:
        picture = plain_picture(frame)
        seen, calibration, colour = picture.view, picture.calibration, frame.image
    else:
        view.check_frame(frame, calibration)
        seen = view.make_view(frame, resampler, gray=True)
        colour = view.make_view(frame, resampler, gray=False).image
    keypoints = features.detect(seen, options)
    drawing = draw_keypoints(view.to_colour(colour), keypoints, *_removed(seen, options))
    write_drawing(staging / f"{Path(file.name).stem}{SUFFIX}", drawing)
    return file.name, keypoints, features.to_features(seen, keypoints, calibration)


def _removed(seen: View, options: FeatureOptions) -> tuple[BoolArray, BoolArray]:
    """Return (h, w) masks of what cleaning made black and what the region of interest excludes."""
    shown = features.prepare(seen, options)
    was_seen = seen.mask > 0
    cleaned = was_seen & (shown.gray == 0) & (seen.image > 0)
    return cleaned, was_seen & (shown.allowed == 0)
