"""`slam stitch --dry-run`: what is wrong with the frames, and what mapping them will take."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from slamcli.core.arrays import Float64Array
from slamcli.core.camera.footprint import default_metres_per_pixel
from slamcli.core.errors import FrameError
from slamcli.io.frames import FrameFile, read_frame, read_reduced_gray
from slamcli.mapping.mapper import Mapper
from slamcli.run.inputs import Inputs, open_inputs
from slamcli.run.paint.frame_cache import size_text
from slamcli.run.session.executor import Progress, ordered
from slamcli.run.stitch.options import StitchOptions
from slamcli.stages.mosaic.painter import Painter

_PROBES, _PROBE_FRAMES = 4, 3
_DARK_GRAY, _WHITE_GRAY, _MAX_WHITE = 25.0, 250, 0.25
# Detail of a frame, as a share of what its neighbours have, below which it is blurred.
_MIN_DETAIL = 0.4
_NEIGHBOURS = 5
_MAX_PAUSE = 5.0
_MIN_OVERLAP = 0.3
_NAMES_SHOWN = 4


@dataclass(frozen=True, slots=True)
class _Look:
    """What a glance at one frame tells.

    Attributes
    ----------
    fault : str
        Why it cannot be read; empty when it can.
    mean, white, detail : float
        Gray level, share of white pixels, and mean square of the Laplacian over the variance.
    digest : int
        Of its pixels.
    """

    fault: str
    mean: float = 0.0
    white: float = 0.0
    detail: float = 0.0
    digest: int = 0


def forecast(
    sources: Sequence[Path],
    calibration_path: Path | None,
    options: StitchOptions,
    progress: Progress,
) -> list[str]:
    """Look at every frame and register a few; return what to tell the user. Nothing is written.

    Raises
    ------
    InputError, CalibrationError
    """
    inputs = open_inputs(sources, calibration_path, options.frame_rate, options.max_range_metres)
    looks = []
    for done, look in enumerate(ordered(_look, inputs.files, options.workers), start=1):
        looks.append(look)
        progress("looking", done, len(inputs.files))
    lines = [inputs.note] if inputs.note else []
    lines.append(f"{'frames':<12} {len(inputs.files)}")
    problems = _problems(inputs.files, looks)
    lines += [f"{'problem':<12} {problem}" for problem in problems]
    if not problems:
        lines.append(f"{'problem':<12} none found")
    return lines + _costs(inputs, options)


def _look(file: FrameFile) -> _Look:
    try:
        gray = read_reduced_gray(file)
    except FrameError as error:
        return _Look(str(error))
    values = gray.astype(np.float32)
    laplacian = np.asarray(cv2.Laplacian(values, cv2.CV_32F))
    detail = float(np.mean(laplacian**2) / max(float(values.var()), 1.0))
    white = float(np.mean(gray >= _WHITE_GRAY))
    return _Look("", float(values.mean()), white, detail, hash(gray.tobytes()))


def _problems(files: Sequence[FrameFile], looks: Sequence[_Look]) -> list[str]:
    """Return a line for each kind of trouble."""
    names = [file.name for file in files]
    read = [number for number, look in enumerate(looks) if not look.fault]
    found = [f"{names[n]}: {look.fault}" for n, look in enumerate(looks) if look.fault]
    same = [b for a, b in pairwise(read) if looks[a].digest == looks[b].digest]
    kinds = [
        ("too dark", [n for n in read if looks[n].mean < _DARK_GRAY]),
        ("overexposed", [n for n in read if looks[n].white > _MAX_WHITE]),
        ("blurred", _blurred([looks[n].detail for n in read], read)),
        ("same picture as the one before", same),
    ]
    stamps = [(n, file.stamp) for n, file in enumerate(files) if file.stamp is not None]
    steps = [(b, after - before) for (_, before), (b, after) in pairwise(stamps)]
    kinds.append(("stamp not after the one before", [n for n, step in steps if step <= 0]))
    if steps:
        usual = float(np.median([step for _, step in steps]))
        late = [n for n, step in steps if step > _MAX_PAUSE * usual > 0]
        kinds.append(("a long pause before", late))
    return found + [
        f"{kind}: {len(members)} ({_some([names[n] for n in members])})"
        for kind, members in kinds
        if members
    ]


def _some(names: Sequence[str]) -> str:
    shown = ", ".join(names[:_NAMES_SHOWN])
    return shown if len(names) <= _NAMES_SHOWN else f"{shown}, ..."


def _blurred(details: Sequence[float], numbers: Sequence[int]) -> list[int]:
    """Return the frames with much less detail than those around them: the floor may change."""
    values: Float64Array = np.array(details)
    found = []
    for place, number in enumerate(numbers):
        around = values[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]
        if values[place] < _MIN_DETAIL * float(np.median(around)):
            found.append(number)
    return found


def _costs(inputs: Inputs, options: StitchOptions) -> list[str]:
    """Register a few runs of frames; return what all of it will come to."""
    files, calibration = inputs.files, inputs.calibration
    scale = options.products.paint.metres_per_pixel or default_metres_per_pixel(calibration)
    painter = Painter(calibration, scale, options.products.paint)
    starts = np.linspace(0, max(0, len(files) - _PROBE_FRAMES), _PROBES).astype(int)
    shares, count, started = [], 0, time.perf_counter()
    for start in sorted(set(starts.tolist())):
        mapper = Mapper(calibration, options.mapper)
        for file in files[start : start + _PROBE_FRAMES]:
            try:
                mapper.update(read_frame(file))
            except FrameError:
                continue
            count += 1
            shares += [trial.overlap for trial in mapper.trials[:1] if trial.link is not None]
    seconds = (time.perf_counter() - started) / max(count, 1) * len(files)
    if not shares:
        return [f"{'forecast':<12} none of the frames tried overlap: they cannot be placed"]
    overlap = float(np.median(shares))
    area = cv2.contourArea(painter.hull.astype(np.float32)[:, None])
    seen = area * (1.0 + (len(files) - 1) * (1.0 - overlap))
    pixels = seen / scale**2
    memory = min(options.products.memory_bytes, len(files) * painter.picture_bytes)
    note = "; too little: drive slower or take more frames" if overlap < _MIN_OVERLAP else ""
    return [
        f"{'overlap':<12} {overlap:.0%} of a view is in the one before{note}",
        f"{'map':<12} about {seen:.3g} {calibration.unit}², {pixels / 1e6:.3g} Mpx of {scale:g} "
        f"{calibration.unit}, if nothing is seen twice",
        f"{'takes':<12} about {size_text(3 * pixels)} of disk while painting, "
        f"{size_text(memory)} of memory for pictures, {seconds / options.workers:.0f} s to locate",
    ]
