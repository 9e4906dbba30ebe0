"""`slam warp`: every frame to a metric bird's-eye picture with a world file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from glob import escape
from pathlib import Path

from slamcli.core.camera.calibration import Calibration
from slamcli.core.camera.footprint import default_metres_per_pixel
from slamcli.core.errors import FrameError, InputError
from slamcli.io.files import output_folder
from slamcli.io.frames import FrameFile, read_frame
from slamcli.io.raster import world_file
from slamcli.run.inputs import open_inputs
from slamcli.run.session.executor import Progress, ordered
from slamcli.stages import view
from slamcli.stages.view import Resampler


def warp(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    *,
    metres_per_pixel: float | None,
    max_range_metres: float | None,
    workers: int,
    overwrite: bool,
    progress: Progress,
) -> list[str]:
    """Write one PNG and one world file a frame into `output`; return what to tell the user.

    Raises
    ------
    InputError, CalibrationError, OutputError
        InputError too when no frame at all could be warped.
    """
    inputs = open_inputs(sources, calibration_path, max_range_metres=max_range_metres)
    names = [Path(file.name).stem for file in inputs.files]
    if len(set(names)) < len(names):
        raise InputError("two frames have the same name; warp their folders one at a time")
    scale = metres_per_pixel or default_metres_per_pixel(inputs.calibration)
    resampler = view.make_view_resampler(inputs.calibration, scale)
    grid = resampler.grid
    products = tuple(f"{escape(name)}{suffix}" for name in names for suffix in (".png", ".pgw"))
    lines = [inputs.note] if inputs.note else []
    skipped = []
    with output_folder(output, products, overwrite=overwrite) as staging:
        work = partial(_warp_frame, inputs.calibration, resampler, staging)
        for done, reason in enumerate(ordered(work, inputs.files, workers), start=1):
            skipped += [f"skipped {reason}"] if reason else []
            progress("warping", done, len(inputs.files))
        if len(skipped) == len(inputs.files):
            raise InputError(f"no frame could be warped; {skipped[0]}")
    unit = inputs.calibration.unit
    lines += [
        *skipped,
        f"{len(inputs.files) - len(skipped)} of {len(inputs.files)} frames: {grid.width}x"
        f"{grid.height} pixels of {grid.metres_per_pixel:g} {unit}, x {grid.x_min:.3f} to "
        f"{grid.x_max:.3f} {unit} ahead (to the right), y {grid.y_min:.3f} to {grid.y_max:.3f} "
        f"{unit} left (up), in {output}",
    ]
    return lines


def _warp_frame(
    calibration: Calibration, resampler: Resampler, staging: Path, file: FrameFile
) -> str:
    """Write one frame's picture; return its name and why it was skipped, or nothing."""
    try:
        frame = read_frame(file)
        view.check_frame(frame, calibration)
    except FrameError as error:
        return f"{file.name}: {error}"
    seen = view.make_view(frame, resampler, gray=False)
    path = staging / f"{Path(file.name).stem}.png"
    world_file.write_georeferenced_png(path, view.to_colour(seen.image), seen.mask, seen.grid)
    return ""
