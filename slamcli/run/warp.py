"""`slam warp`: every frame to a metric bird's-eye picture with a world file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import check_metres_per_pixel, default_metres_per_pixel
from slamcli.core.config import FrameSelection
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.raster import world_file
from slamcli.run.command_report import Report
from slamcli.run.inputs import open_inputs
from slamcli.run.per_frame import Skipped, each_frame, frame_outputs
from slamcli.run.session.session import Session
from slamcli.stages import view
from slamcli.stages.view import Resampler

# Some gigabytes of memory.
_MAX_VIEW_PIXELS = 2**28


def warp(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    *,
    metres_per_pixel: float | None,
    max_range_metres: float | None,
    selection: FrameSelection | None = None,
    overwrite: bool,
    session: Session,
) -> Report:
    """Write one PNG and one world file a frame into `output`.

    Raises
    ------
    InputError, CalibrationError, OutputError
        InputError also when no frame at all can be warped.
    """
    inputs = open_inputs(
        sources, calibration_path, None, max_range_metres, selection, session.progress
    )
    scale = metres_per_pixel or default_metres_per_pixel(inputs.calibration)
    check_metres_per_pixel(inputs.calibration, scale, _MAX_VIEW_PIXELS)
    resampler = view.make_view_resampler(inputs.calibration, scale)
    grid = resampler.grid
    suffixes = (".png", ".pgw")
    with frame_outputs(
        inputs.files, output, suffixes, inputs=inputs.paths, overwrite=overwrite
    ) as staging:
        work = partial(_warp_frame, inputs.calibration, resampler, staging)
        results = each_frame("warping", work, inputs.files, session)
    skipped = [result.reason for result in results if isinstance(result, Skipped)]
    unit = inputs.calibration.unit
    lines = [
        *([inputs.note] if inputs.note else []),
        *(f"skipped {reason}" for reason in skipped),
        f"{len(inputs.files) - len(skipped)} of {len(inputs.files)} frames: {grid.width}x"
        f"{grid.height} pixels of {grid.metres_per_pixel:g} {unit}, x {grid.x_min:.3f} to "
        f"{grid.x_max:.3f} {unit} ahead (to the right), y {grid.y_min:.3f} to {grid.y_max:.3f} "
        f"{unit} left (up), in {output}",
    ]
    facts = {
        "frames": len(inputs.files),
        "warped": len(inputs.files) - len(skipped),
        "skipped": skipped,
        "grid": asdict(grid),
        "unit": unit,
        "output": output,
    }
    return Report(tuple(lines), facts)


def _warp_frame(
    calibration: Calibration, resampler: Resampler, staging: Path, file: FrameFile
) -> None:
    """Write one frame's picture and world file. Raises FrameError."""
    frame = read_frame(file)
    view.check_frame(frame, calibration)
    seen = view.make_view(frame, resampler, gray=False)
    path = staging / f"{Path(file.name).stem}.png"
    world_file.write_georeferenced_png(path, view.to_colour(seen.image), seen.mask, seen.grid)
