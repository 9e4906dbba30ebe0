"""`slam stitch --dry-run`: the faults of the frames, and a forecast of what mapping them takes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.errors import FrameError
from slamcli.io.frames import FrameFile, read_frame, read_reduced_gray
from slamcli.mapping.mapper import Mapper
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.paint.budget import size_text
from slamcli.run.paint.outputs import check_products
from slamcli.run.paint.paint import make_painter
from slamcli.run.session.session import Session
from slamcli.run.stitch.options import StitchOptions

# Places along the drive where frames are registered, and frames at each.
_PROBES, _PROBE_FRAMES = 4, 3
# Faults are only reported [guarded by tests/run/stitch/test_dry_run.py].
_MIN_MEAN_GRAY, _WHITE_GRAY, _MAX_WHITE_SHARE = 25.0, 250, 0.25
# Detail of a frame, as a share of the median of its neighbours', below which it is blurred.
_MIN_DETAIL_SHARE = 0.4
_NEIGHBOURS = 5
# A longer time between two frames, in medians of all times between two, is a pause.
_MAX_PAUSE = 5.0
_MIN_OVERLAP = 0.3
_MAX_NAMES = 4


@dataclass(frozen=True, slots=True)
class _FrameCheck:
    """Statistics of one frame's gray picture, reduced.

    Attributes
    ----------
    fault : str
        Why it cannot be read; empty when it can.
    mean_gray, white_share, detail : float
        Gray level, share of white pixels, and mean square of the Laplacian over the variance.
    digest : int
        Of its pixels.
    """

    fault: str
    mean_gray: float = 0.0
    white_share: float = 0.0
    detail: float = 0.0
    digest: int = 0


def forecast(
    sources: Sequence[Path],
    calibration_path: Path | None,
    options: StitchOptions,
    *,
    session: Session,
) -> list[str]:
    """Check every frame and register a few; return the lines to print. Nothing is written.

    Raises
    ------
    InputError, CalibrationError
    """
    inputs = open_inputs(
        sources,
        calibration_path,
        options.frame_rate,
        options.max_range_metres,
        options.selection,
        session.progress,
    )
    checks = list(session.on_this_machine().stage("checking", _check, inputs.files))
    problems = _problems(inputs.files, checks) or ["none found"]
    return [
        *([inputs.note] if inputs.note else []),
        f"{'frames':<12} {len(inputs.files)}",
        *(f"{'problem':<12} {problem}" for problem in problems),
        *_costs(inputs, options, session.workers),
    ]


def _check(file: FrameFile) -> _FrameCheck:
    try:
        gray = read_reduced_gray(file)
    except FrameError as error:
        return _FrameCheck(str(error))
    values = gray.astype(np.float32)
    laplacian = np.asarray(cv2.Laplacian(values, cv2.CV_32F))
    detail = float(np.mean(laplacian**2) / max(float(values.var()), 1.0))
    white = float(np.mean(gray >= _WHITE_GRAY))
    return _FrameCheck("", float(values.mean()), white, detail, hash(gray.tobytes()))


def _problems(files: Sequence[FrameFile], checks: Sequence[_FrameCheck]) -> list[str]:
    """Return a line for each frame that cannot be read, and one for each kind of fault."""
    names = [file.name for file in files]
    unread = [f"{names[n]}: {check.fault}" for n, check in enumerate(checks) if check.fault]
    read = [number for number, check in enumerate(checks) if not check.fault]
    same = [b for a, b in pairwise(read) if checks[a].digest == checks[b].digest]
    kinds = {
        "too dark": [n for n in read if checks[n].mean_gray < _MIN_MEAN_GRAY],
        "overexposed": [n for n in read if checks[n].white_share > _MAX_WHITE_SHARE],
        "blurred": _blurred([checks[n].detail for n in read], read),
        "same picture as the one before": same,
        **_stamp_faults(files),
    }
    return unread + [
        f"{kind}: {len(members)} ({_some([names[n] for n in members])})"
        for kind, members in kinds.items()
        if members
    ]


def _stamp_faults(files: Sequence[FrameFile]) -> dict[str, list[int]]:
    """Return the frames whose stamps go back or leave a pause, by the kind of fault."""
    stamps = [(n, file.stamp) for n, file in enumerate(files) if file.stamp is not None]
    steps = [(b, after - before) for (_, before), (b, after) in pairwise(stamps)]
    usual = float(np.median([step for _, step in steps])) if steps else 0.0
    return {
        "stamp not after the one before": [n for n, step in steps if step <= 0],
        "a long pause before": [n for n, step in steps if step > _MAX_PAUSE * usual > 0],
    }


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_MAX_NAMES])
    return shown if len(names) <= _MAX_NAMES else f"{shown}, ..."


def _blurred(details: Sequence[float], numbers: Sequence[int]) -> list[int]:
    """Return the frames with much less detail than their neighbours: floors differ in detail."""
    values: Float64Array = np.array(details)
    found = []
    for place, number in enumerate(numbers):
        around = values[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]
        if values[place] < _MIN_DETAIL_SHARE * float(np.median(around)):
            found.append(number)
    return found


def _costs(inputs: Inputs, options: StitchOptions, workers: int) -> list[str]:
    """Return the forecast: overlap, size of the map, disk, memory and time."""
    frames, unit = len(inputs.files), inputs.calibration.unit
    check_products(options.products, inputs.calibration)
    painter = make_painter(inputs.calibration, options.products)
    scale = painter.metres_per_pixel
    overlaps, seconds = _probe(inputs, options)
    if not overlaps:
        return [f"{'forecast':<12} none of the frames tried overlap: they cannot be placed"]
    overlap = float(np.median(overlaps))
    view_area = cv2.contourArea(painter.hull.astype(np.float32)[:, None])
    area = view_area * (1.0 + (frames - 1) * (1.0 - overlap))
    pixels = area / scale**2
    memory = min(options.products.memory_bytes, frames * painter.picture_bytes)
    note = "; too little: drive slower or take more frames" if overlap < _MIN_OVERLAP else ""
    return [
        f"{'overlap':<12} {overlap:.0%} of a view is in the one before{note}",
        f"{'map':<12} about {area:.3g} {unit}², {pixels / 1e6:.3g} Mpx of {scale:g} {unit}, "
        "if nothing is seen twice",
        f"{'takes':<12} about {size_text(3 * pixels)} of disk while painting, "
        f"{size_text(memory)} of memory for pictures, {frames * seconds / workers:.0f} s to locate",
    ]


def _probe(inputs: Inputs, options: StitchOptions) -> tuple[list[float], float]:
    """Register some frames along the drive; return their overlaps, and the seconds for one."""
    files = inputs.files
    starts = np.linspace(0, max(0, len(files) - _PROBE_FRAMES), _PROBES).astype(int)
    overlaps, count, started = [], 0, time.perf_counter()
    for start in sorted(set(starts.tolist())):
        mapper = Mapper(inputs.calibration, options.mapper)
        for file in files[start : start + _PROBE_FRAMES]:
            try:
                mapper.update(read_frame(file))
            except FrameError:
                continue
            count += 1
            overlaps += [one.overlap for one in mapper.registrations[:1] if one.link is not None]
    return overlaps, (time.perf_counter() - started) / max(count, 1)
