"""`slam stitch`: frames in; a mosaic, poses and the pictures that explain them out."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from slamcli import __version__
from slamcli.core.errors import InputError
from slamcli.core.geometry import apply_homography, invert, path_length
from slamcli.io import rasters, tables
from slamcli.io.calibrations import save_calibration
from slamcli.io.files import output_folder, write_image
from slamcli.io.frames import read_frame
from slamcli.io.poses import write_poses
from slamcli.mapper import Mapper, placed_fragments
from slamcli.painter import Painter
from slamcli.refine import Registration
from slamcli.run import exports
from slamcli.run.executor import ordered
from slamcli.run.inputs import open_inputs
from slamcli.run.refinement import describe, read_and_prepare, run_section, self_calibrate
from slamcli.stages import camera, view
from slamcli.stages.draw.matches import draw_matches
from slamcli.stages.draw.trajectory import draw_trajectory
from slamcli.stages.mosaic import Canvas

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from slamcli.comparison import Trial
    from slamcli.core.config import MapperOptions
    from slamcli.core.records import PoseEstimate, Prepared, Tile
    from slamcli.io.frames import FrameFile
    from slamcli.refine import Refinement
    from slamcli.run.executor import Progress
    from slamcli.run.inputs import Inputs

PRODUCTS = (
    "mosaic*.png",
    "mosaic*.yaml",
    "mosaic*.pgw",
    "poses.csv",
    "trajectory*.png",
    "run.toml",
    "calibration.yaml",
    *exports.PRODUCTS,
)
DEBUG_PRODUCTS = "matches"
# A PNG of more than this would not open in most viewers.
LARGEST_MOSAIC_PIXELS = 400_000_000


@dataclass(frozen=True, slots=True)
class StitchOptions:
    """What `slam stitch` was told.

    Attributes
    ----------
    mapper : MapperOptions
    metres_per_pixel : float or None
        Of the mosaic; None chooses it from the camera's sampling.
    max_range_metres : float or None
        Overrides the calibration's far limit.
    frame_rate : float or None
        Frames per second, for stamps.
    debug : bool
        Also draw every frame's matches.
    self_calibrate : bool
        Refine the camera by the frames themselves, where they determine it.
    export : tuple of str
        What else to write; see `slamcli.run.exports`.
    workers : int
        Threads.
    """

    mapper: MapperOptions
    metres_per_pixel: float | None = None
    max_range_metres: float | None = None
    frame_rate: float | None = None
    debug: bool = False
    self_calibrate: bool = False
    export: tuple[str, ...] = ()
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
) -> StitchReport:
    """Map the frames of folders or files into `output`.

    Raises
    ------
    InputError, CalibrationError, OutputError
    """
    started = time.monotonic()
    inputs = open_inputs(sources, calibration_path, options.frame_rate, options.max_range_metres)
    exports.check_exports(options.export, inputs.files)
    with output_folder(output, (*PRODUCTS, DEBUG_PRODUCTS), overwrite=overwrite) as staging:
        mapper = Mapper(inputs.calibration, options.mapper)
        estimates = _locate(mapper, inputs, options, staging, progress)
        found = Registration(inputs.calibration, estimates, mapper.links)
        refined = None
        if options.self_calibrate:
            refined = self_calibrate(inputs, found, options.mapper, options.workers, progress)
            found = refined.registration
            inputs = replace(inputs, calibration=found.calibration)
            save_calibration(staging / "calibration.yaml", found.calibration)
        area = _write_maps(inputs, found.estimates, options, staging, progress)
        write_poses(staging / "poses.csv", found.estimates)
        seconds = time.monotonic() - started
        exports.write_exports(staging, options.export, found.estimates, found.links)
        _write_run(staging, inputs, options, found, mapper.metres_per_pixel, refined)
    return _report(inputs, found.estimates, area, seconds, output, refined)


def _locate(
    mapper: Mapper, inputs: Inputs, options: StitchOptions, staging: Path, progress: Progress
) -> list[PoseEstimate]:
    """First walk: every frame to its pose or its reason."""
    total = len(inputs.files)
    work = partial(read_and_prepare, mapper)
    for done, prepared in enumerate(ordered(work, inputs.files, options.workers), start=1):
        mapper.step(prepared)
        if options.debug:
            _draw_trials(mapper.trials, staging / "matches")
        progress("locating", done, total)
    return mapper.finish()


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


def _write_maps(
    inputs: Inputs,
    estimates: Sequence[PoseEstimate],
    options: StitchOptions,
    staging: Path,
    progress: Progress,
) -> float:
    """Second walk: paint every fragment; return the floor seen in all, in square metres."""
    fragments = placed_fragments(estimates)
    total = sum(len(members) for members in fragments.values())
    metres_per_pixel = options.metres_per_pixel or camera.default_metres_per_pixel(
        inputs.calibration
    )
    area, done = 0.0, 0
    for fragment, members in fragments.items():
        suffix = "" if fragment == 0 else f"_{fragment}"
        painter = Painter(inputs.calibration, metres_per_pixel)
        _check_extent(painter, members)
        canvas = Canvas(metres_per_pixel)
        jobs = [(inputs.files[member.index], member) for member in members]
        for patch in ordered(partial(_paint, painter), jobs, options.workers):
            canvas.paint(patch)
            done += 1
            progress("painting", done, total)
        grid = canvas.extent()
        if grid is None:
            continue
        area += canvas.seen_area()
        image, mask = canvas.flatten(grid)
        name = f"mosaic{suffix}.png"
        rasters.write_georeferenced_png(staging / name, image, mask, grid)
        rasters.write_nav2_map(
            staging / f"mosaic{suffix}.yaml", name, grid, inputs.calibration.unit
        )
        drawing = draw_trajectory(image, mask, grid, members, inputs.calibration.unit)
        write_image(staging / f"trajectory{suffix}.png", drawing)
    return area


def _paint(painter: Painter, job: tuple[FrameFile, PoseEstimate]) -> Tile:
    file, estimate = job
    assert estimate.map_from_robot is not None
    return painter.patch(read_frame(file), estimate.map_from_robot, estimate.rocking)


def _check_extent(painter: Painter, members: Sequence[PoseEstimate]) -> None:
    """Refuse a mosaic too large for one PNG before it is painted, and say what would fit."""
    grid = painter.extent([e.map_from_robot for e in members if e.map_from_robot is not None])
    if grid.width * grid.height > LARGEST_MOSAIC_PIXELS:
        fitting = grid.metres_per_pixel * (grid.width * grid.height / LARGEST_MOSAIC_PIXELS) ** 0.5
        raise InputError(
            f"the mosaic would have {grid.width}x{grid.height} pixels; "
            f"use --metres-per-pixel {fitting * 1.05:.2g} or more"
        )


def _write_run(
    staging: Path,
    inputs: Inputs,
    options: StitchOptions,
    found: Registration,
    view_metres_per_pixel: float,
    refined: Refinement | None,
) -> None:
    estimates = found.estimates
    sections: dict[str, dict[str, tables.Scalar]] = {
        "": {
            "version": __version__,
            "calibration": str(inputs.calibration_path) if inputs.calibration_path else None,
            "unit": inputs.calibration.unit,
            "first_frame": str(inputs.files[0].path),
            "registration_metres_per_pixel": view_metres_per_pixel,
        }
    }
    for section, key, value in tables.flatten(options):
        sections.setdefault(f"options.{section}".rstrip("."), {})[key] = value
    sections["counts"] = {
        "frames": len(estimates),
        "placed": sum(e.map_from_robot is not None for e in estimates),
        "lost": sum(e.status == "lost" for e in estimates),
        "fragments": len(placed_fragments(estimates)),
        "links": len(found.links),
    }
    if refined is not None:
        sections["self_calibration"] = run_section(refined)
    tables.write_toml(staging / "run.toml", sections)


def _report(
    inputs: Inputs,
    estimates: Sequence[PoseEstimate],
    area_square_metres: float,
    seconds: float,
    output: Path,
    refined: Refinement | None,
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
    lines += [] if refined is None else describe(refined)
    lines += [f"{name:<12} {value}" for name, value in rows]
    return StitchReport(tuple(lines), 0 if placed else 1)
