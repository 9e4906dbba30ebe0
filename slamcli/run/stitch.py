"""`slam stitch`: frames in; a mosaic, poses and the pictures that explain them out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

from slamcli import __version__
from slamcli.core.config import ProductOptions
from slamcli.core.errors import FrameError
from slamcli.core.geometry import apply_homography, invert, path_length
from slamcli.core.records import PoseEstimate, Prepared
from slamcli.io import runs, tables
from slamcli.io.checkpoints import Checkpoint, run_key
from slamcli.io.files import move_folder, output_folder, remove_folder, write_image
from slamcli.io.frames import read_frame
from slamcli.io.poses import write_poses
from slamcli.mapper import Mapper, placed_fragments
from slamcli.run import exports, products
from slamcli.run.executor import ordered
from slamcli.run.inputs import open_inputs
from slamcli.run.interruption import interruptible
from slamcli.run.painting import make_scene, turned
from slamcli.stages import view
from slamcli.stages.draw.matches import draw_matches

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from slamcli.comparison import Trial
    from slamcli.core.config import MapperOptions
    from slamcli.io.frames import FrameFile
    from slamcli.run.executor import Progress
    from slamcli.run.inputs import Inputs
    from slamcli.run.interruption import Interruption
    from slamcli.run.painting import Scene

PRODUCTS = ("poses.csv", "run.toml", *products.PRODUCTS, *exports.PRODUCTS)
DEBUG_PRODUCTS = "matches"
# A state is kept so often, and takes at most this share of the time.
_SAVE_SECONDS, _SAVE_SHARE = 5.0, 0.05
# The exit code of a program that SIGINT ended.
_INTERRUPTED = 130


@dataclass(frozen=True, slots=True)
class StitchOptions:
    """What `slam stitch` was told.

    Attributes
    ----------
    mapper : MapperOptions
    products : ProductOptions
        What is painted and written.
    max_range_metres : float or None
        Overrides the calibration's far limit.
    frame_rate : float or None
        Frames per second, for stamps.
    debug : bool
        Also draw every frame's matches.
    export : tuple of str
        What else to write; see `slamcli.run.exports`.
    resume : bool
        Go on with a run of the same frames and options that was cut off.
    workers : int
        Threads.
    """

    mapper: MapperOptions
    products: ProductOptions = field(default_factory=ProductOptions)
    max_range_metres: float | None = None
    frame_rate: float | None = None
    debug: bool = False
    export: tuple[str, ...] = ()
    resume: bool = False
    workers: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class StitchReport:
    """What came of it, as the lines of the closing table, and the exit code."""

    lines: tuple[str, ...]
    exit_code: int


def stitch(
    sources: Sequence[Path],
    calibration_path: Path | None,
    output: Path,
    options: StitchOptions,
    *,
    overwrite: bool,
    progress: Progress,
    tell: Callable[[str], None],
) -> StitchReport:
    """Map the frames of folders or files into `output`.

    Raises
    ------
    InputError, CalibrationError, OutputError
    """
    started = time.monotonic()
    inputs = open_inputs(sources, calibration_path, options.frame_rate, options.max_range_metres)
    exports.check_exports(options.export, inputs.files)
    products.check_formats(options.products)
    patterns = (*PRODUCTS, DEBUG_PRODUCTS)
    with (
        interruptible() as interruption,
        Checkpoint(output) as checkpoint,
        output_folder(output, patterns, overwrite=overwrite, resume=options.resume) as staging,
    ):
        mapper = _begin(inputs, options, checkpoint, tell)
        estimates = _locate(mapper, inputs, options, checkpoint, progress, interruption)
        scenes = _scenes(inputs, estimates, options)
        # Tiles of poses that more frames would change are of no use to a run that goes on.
        unfinished = staging / "tiles"
        area = products.write_maps(
            scenes,
            options.products,
            staging,
            unfinished if interruption.happened else checkpoint.tiles,
            options.workers,
            progress,
            tell,
            interruption,
        )
        remove_folder(unfinished)
        write_poses(staging / "poses.csv", estimates)
        seconds = time.monotonic() - started
        exports.write_exports(staging, options.export, estimates, mapper.links)
        _write_run(staging, sources, inputs, options, estimates, mapper)
        move_folder(checkpoint.drawings, staging / DEBUG_PRODUCTS)
        if interruption.happened:
            checkpoint.keep()
    return _report(inputs, estimates, area, seconds, output, interruption)


def _begin(
    inputs: Inputs, options: StitchOptions, checkpoint: Checkpoint, tell: Callable[[str], None]
) -> Mapper:
    """Return a new mapper, or that of a run that was cut off."""
    total = len(inputs.files)
    paths = [file.path for file in inputs.files]
    if inputs.calibration_path is not None:
        paths.append(inputs.calibration_path)
    plain = replace(options, resume=False, workers=1)
    if checkpoint.open(run_key(f"{__version__} {plain!r}", paths), resume=options.resume):
        mapper = checkpoint.load()
        if isinstance(mapper, Mapper):
            tell(f"resumed: {len(mapper.estimates)} of {total} frames had been located")
            return mapper
    elif options.resume:
        tell("nothing to resume: no run of these frames and options was cut off; starting anew")
    return Mapper(inputs.calibration, options.mapper)


def _locate(
    mapper: Mapper,
    inputs: Inputs,
    options: StitchOptions,
    checkpoint: Checkpoint,
    progress: Progress,
    interruption: Interruption,
) -> list[PoseEstimate]:
    """First walk: every frame to its pose or its reason; those that a mapper has seen are done."""
    total, first = len(inputs.files), len(mapper.estimates)
    work = partial(_read_and_prepare, mapper)
    pace = _Pace()
    prepared_frames = ordered(work, inputs.files[first:], options.workers)
    for done, prepared in enumerate(prepared_frames, start=first + 1):
        mapper.step(prepared)
        if options.debug:
            _draw_trials(mapper.trials, checkpoint.drawings)
        progress("locating", done, total)
        stop = interruption.heeded()
        if stop or pace.due() or done == total:
            pace.saving(lambda: checkpoint.save(mapper))
        if stop:
            break
    reason = "not reached: interrupted"
    missed = [
        PoseEstimate(file.index, file.name, file.stamp, None, "lost", reason)
        for file in inputs.files[len(mapper.estimates) :]
    ]
    return [*mapper.finish(), *missed]


class _Pace:
    """When to save a state next: not before long, and never for more than a share of the time."""

    def __init__(self) -> None:
        self._wait, self._last = _SAVE_SECONDS, time.monotonic()

    def due(self) -> bool:
        return time.monotonic() - self._last >= self._wait

    def saving(self, save: Callable[[], None]) -> None:
        started = time.monotonic()
        save()
        self._last = time.monotonic()
        self._wait = max(_SAVE_SECONDS, (self._last - started) / _SAVE_SHARE)


def _draw_trials(trials: Sequence[Trial], folder: Path) -> None:
    """Draw every comparison that placed a frame, or failed to."""
    for trial in trials:
        first, second, fit = trial.keyframe, trial.prepared, trial.alignment
        picture_first, points_first, to_first = _drawable(first, fit.matches[:, 0])
        picture_second, points_second, to_second = _drawable(second, fit.matches[:, 1])
        if trial.link is not None:
            a_from_b: NDArray[np.float64] | None = trial.link.a_from_b.matrix
            verdict = f"placed, correlation {trial.link.score:.3f}"
        else:
            a_from_b = fit.a_from_b if fit.accepted else None
            verdict = trial.reason
        second_from_first = None
        if a_from_b is not None:
            second_from_first = to_second @ invert(a_from_b) @ invert(to_first)
        header = [
            f"{second.name} on {first.name}: {verdict}",
            f"{fit.inlier_count} inliers of {len(fit.matches)} matches, "
            f"overlap {trial.overlap:.0%}; the robot looks to the right",
        ]
        drawing = draw_matches(
            picture_first,
            picture_second,
            points_first,
            points_second,
            fit.inliers,
            second_from_first,
            header,
        )
        write_image(folder / f"{second.index:04d}_to_{first.index:04d}.png", drawing)


def _drawable(
    prepared: Prepared, chosen: NDArray[np.int32]
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]:
    """Return a frame's view, its chosen points in that view's pixels, and pixel_from_metres."""
    assert prepared.view is not None
    assert prepared.features is not None
    pixel_from_metres = prepared.view.grid.pixel_from_metres
    points = apply_homography(pixel_from_metres, prepared.features.points[chosen])
    return view.to_colour(prepared.view.image), points, pixel_from_metres


def _read_and_prepare(mapper: Mapper, file: FrameFile) -> Prepared:
    try:
        return mapper.prepare(read_frame(file))
    except FrameError as error:
        return Prepared(file.index, file.name, file.stamp, None, None, str(error))


def _scenes(
    inputs: Inputs, estimates: Sequence[PoseEstimate], options: StitchOptions
) -> list[tuple[Scene, list[PoseEstimate]]]:
    """Return what is painted: every fragment, with its frames."""
    scenes = []
    for members in placed_fragments(estimates).values():
        files = [inputs.files[estimate.index] for estimate in members]
        poses = [e.map_from_robot for e in members if e.map_from_robot is not None]
        scene = make_scene(inputs.calibration, files, poses, None, options.products.turn_radians)
        scenes.append((scene, turned(members, scene)))
    return scenes


def _write_run(
    staging: Path,
    sources: Sequence[Path],
    inputs: Inputs,
    options: StitchOptions,
    estimates: Sequence[PoseEstimate],
    mapper: Mapper,
) -> None:
    sections: dict[str, dict[str, tables.Scalar]] = {
        "": {
            "version": __version__,
            "calibration": str(inputs.calibration_path) if inputs.calibration_path else None,
            "unit": inputs.calibration.unit,
            "first_frame": str(inputs.files[0].path),
            "sources": runs.source_text(sources),
            "registration_metres_per_pixel": mapper.metres_per_pixel,
        }
    }
    sections["camera"] = runs.camera_section(inputs.calibration)
    for section, key, value in tables.flatten(replace(options, resume=False)):
        sections.setdefault(f"options.{section}".rstrip("."), {})[key] = value
    sections["counts"] = {
        "frames": len(estimates),
        "placed": sum(e.map_from_robot is not None for e in estimates),
        "lost": sum(e.status == "lost" for e in estimates),
        "fragments": len(placed_fragments(estimates)),
        "links": len(mapper.links),
    }
    tables.write_toml(staging / "run.toml", sections)


def _report(
    inputs: Inputs,
    estimates: Sequence[PoseEstimate],
    area_square_metres: float,
    seconds: float,
    output: Path,
    interruption: Interruption,
) -> StitchReport:
    """Return the closing table; exit 1 when a sequence of frames yields no map at all."""
    fragments = placed_fragments(estimates)
    placed = sum(len(members) for members in fragments.values())
    unit = inputs.calibration.unit
    length = sum(
        path_length([e.map_from_robot for e in members if e.map_from_robot is not None])
        for members in fragments.values()
    )
    rows = [
        ("frames", str(len(estimates))),
        ("placed", f"{placed} ({placed / len(estimates):.0%})"),
        ("fragments", str(len(fragments))),
    ]
    rows += [("lost", f"{e.name}: {e.reason}") for e in estimates if e.status == "lost"]
    rows += [
        ("path length", f"{length:.3f} {unit}"),
        ("area", f"{area_square_metres:.3f} {unit}²"),
        ("time", f"{seconds:.1f} s, {len(estimates) / seconds:.1f} frames/s"),
        ("written to", str(output)),
    ]
    lines = [inputs.note] if inputs.note else []
    if interruption.happened:
        lines.append("interrupted: written is what there was; --resume goes on from there")
    lines += [f"{name:<12} {value}" for name, value in rows]
    code = _INTERRUPTED if interruption.happened else 0 if placed else 1
    return StitchReport(tuple(lines), code)
