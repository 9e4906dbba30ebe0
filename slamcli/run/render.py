"""`slam render`: a finished map painted again with other options; no frame is located again."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

from slamcli.core.config import ProductOptions
from slamcli.core.errors import InputError
from slamcli.core.exit_codes import ExitCode
from slamcli.io.frames import list_frames
from slamcli.io.map_file import MAP_NAME, load_map, map_path
from slamcli.io.outputs import output_folder, remove_folder
from slamcli.run.command_report import Report
from slamcli.run.inputs import map_file_of, map_sources
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
) -> Report:
    """Paint the map of an earlier run into `output`; return what was painted.

    Parameters
    ----------
    run_folder : Path
        Output of `slam stitch`, or any file in it; only its map.slam is read.
    frames : Path or None
        Folder of the frames; None: where the map says that they are.

    Raises
    ------
    InputError, MapError, OutputError
    """
    started = time.monotonic()
    path = run_folder if run_folder.suffix == Path(MAP_NAME).suffix else _folder(run_folder)
    floor_map = load_map(path, for_locating=False)
    outputs.check_products(options, floor_map.calibration)
    remedy = "give their folder with --frames"
    sources = map_sources(floor_map, path, remedy) if frames is None else (frames,)
    files = list_frames(sources, selection=floor_map.selection, progress=session.progress)
    if floor_map.calibration.is_top_down:
        canvas = floor_map.calibration.image_size
        files = [replace(file, canvas=canvas) for file in files]
    estimates = [e for e in floor_map.estimates if e.map_from_robot is not None]
    if not estimates:
        raise InputError(f"{path} has no frame with a pose; there is nothing to paint")
    where = partial(map_file_of, files, remedy=remedy)
    scenes = scenes_of(floor_map.calibration, estimates, where, options, dict(floor_map.datums))
    read = (map_path(path), *(file.path for file in files))
    with (
        session.interruption.on_signals(),
        output_folder(output, outputs.PRODUCTS, inputs=read, overwrite=overwrite) as staging,
    ):
        painted = outputs.write_maps(scenes, options, staging, staging / "tiles", session)
        remove_folder(staging / "tiles")
    unit = floor_map.calibration.unit
    lines = [
        f"{'frames':<12} {len(estimates)}",
        f"{'area':<12} {painted.area_square_metres:.3f} {unit}²",
        f"{'time':<12} {time.monotonic() - started:.1f} s",
        f"{'written to':<12} {output}",
    ]
    facts = {
        "frames": len(estimates),
        "area": painted.area_square_metres,
        "unit": unit,
        "unread": painted.unread,
        "interrupted": session.interruption.happened,
        "output": output,
    }
    if painted.unread:
        lines.insert(0, painted.note)
    if session.interruption.happened:
        lines.insert(0, "interrupted: the map has only the tiles painted so far")
        return Report(tuple(lines), facts, ExitCode.INTERRUPTED)
    code = ExitCode.INCOMPLETE if painted.unread else ExitCode.DONE
    return Report(tuple(lines), facts, code)


def _folder(run_folder: Path) -> Path:
    return run_folder if run_folder.is_dir() else run_folder.parent
