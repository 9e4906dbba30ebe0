"""`slam render`: a finished map painted again, otherwise, without locating a frame anew."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from slamcli.core.config import ProductOptions
from slamcli.core.errors import InputError
from slamcli.core.records import PoseEstimate
from slamcli.io.files import output_folder, remove_folder
from slamcli.io.frames import FrameFile, list_frames
from slamcli.io.runs import read_run
from slamcli.run.paint import outputs
from slamcli.run.paint.scene import scenes_of
from slamcli.run.session.session import Session


def render(
    run_folder: Path,
    frames: Path | None,
    output: Path,
    options: ProductOptions,
    *,
    overwrite: bool,
    session: Session,
) -> list[str]:
    """Paint the map of an earlier run into `output`; return what to tell the user.

    Parameters
    ----------
    run_folder : Path
        Output of `slam stitch`.
    frames : Path or None
        Where the frames are now; None: where they were.

    Raises
    ------
    InputError, OutputError
    """
    started = time.monotonic()
    outputs.check_formats(options)
    run = read_run(run_folder)
    files = list_frames(run.sources if frames is None else [frames])
    where = partial(file_of, files, remedy="give their folder with --frames")
    scenes = scenes_of(run.calibration, run.estimates, where, options.turn_radians)
    with (
        session.interruption.on_sigint(),
        output_folder(output, outputs.PRODUCTS, overwrite=overwrite) as staging,
    ):
        painted = outputs.write_maps(scenes, options, staging, staging / "tiles", session)
        remove_folder(staging / "tiles")
    unit = run.calibration.unit
    lines = [
        f"{'frames':<12} {len(run.estimates)}",
        f"{'area':<12} {painted.area_square_metres:.3f} {unit}²",
        f"{'time':<12} {time.monotonic() - started:.1f} s",
        f"{'written to':<12} {output}",
    ]
    if session.interruption.happened:
        lines.insert(0, "interrupted: the map holds what had been painted")
    return lines


def file_of(files: Sequence[FrameFile], estimate: PoseEstimate, *, remedy: str) -> FrameFile:
    """Return a frame's file, by its place in the sequence, which its name confirms.

    Raises
    ------
    InputError
        When that is another frame; with what to do.
    """
    if estimate.index < len(files) and files[estimate.index].name == estimate.name:
        return files[estimate.index]
    raise InputError(
        f"the frames are not those of the map: frame {estimate.index} was {estimate.name}; {remedy}"
    )
