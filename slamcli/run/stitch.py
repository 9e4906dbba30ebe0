"""`slam stitch`: frames in; a mosaic, poses and the pictures that explain them out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

from slamcli import __version__
from slamcli.core.errors import FrameError, InputError
from slamcli.core.geometry import apply_homography, invert, path_length
from slamcli.core.records import Prepared
from slamcli.core.telemetry import TelemetryOptions
from slamcli.graph import placed_fragments
from slamcli.io import rasters, tables
from slamcli.io.files import output_folder, write_image
from slamcli.io.frames import read_frame
from slamcli.io.maps import MAP_NAME, save_map
from slamcli.io.poses import write_poses
from slamcli.mapper import Mapper
from slamcli.painter import Painter
from slamcli.run import exports
from slamcli.run.executor import ordered
from slamcli.run.inputs import open_inputs
from slamcli.run.networks import (
    NO_NETWORKS,
    NetworkFiles,
    with_match_network,
    with_point_network,
)
from slamcli.run.telemetry import Telemetry, TelemetryFiles, feed, feed_shifted, read_telemetry
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
    from slamcli.core.geometry import Pose2
    from slamcli.core.records import PoseEstimate, Tile
    from slamcli.io.frames import FrameFile
    from slamcli.run.executor import Progress
    from slamcli.run.inputs import Inputs

PRODUCTS = (
    "mosaic*.png",
    "mosaic*.yaml",
    "mosaic*.pgw",
    "poses.csv",
    "trajectory*.png",
    "run.toml",
    MAP_NAME,
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
    telemetry : TelemetryOptions
    networks : NetworkFiles
    metres_per_pixel : float or None
        Of the mosaic; None chooses it from the camera's sampling.
    max_range_metres : float or None
        Overrides the calibration's far limit.
    frame_rate : float or None
        Frames per second, for stamps.
    debug : bool
        Also draw every frame's matches.
    export : tuple of str
        What else to write; see `slamcli.run.exports`.
    workers : int
        Threads.
    """

    mapper: MapperOptions
    telemetry: TelemetryOptions = field(default_factory=TelemetryOptions)
    networks: NetworkFiles = NO_NETWORKS
    metres_per_pixel: float | None = None
    max_range_metres: float | None = None
    frame_rate: float | None = None
    debug: bool = False
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
    telemetry: TelemetryFiles | None = None,
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
    files = telemetry or TelemetryFiles()
    readings = read_telemetry(files, inputs)
    exports.check_exports(options.export, inputs.files, has_gps=bool(readings.gps))
    mapper = Mapper(inputs.calibration, _with_networks(options), options.telemetry)
    if not readings.find_time_offset:
        feed(mapper, readings)
    with output_folder(output, (*PRODUCTS, DEBUG_PRODUCTS), overwrite=overwrite) as staging:
        note = _locate(mapper, inputs, options, readings, staging, progress)
        estimates = mapper.estimates
        area = _write_maps(inputs, estimates, options, staging, progress)
        write_poses(staging / "poses.csv", estimates)
        floor_map = mapper.floor_map()
        if floor_map is not None:
            save_map(staging / MAP_NAME, floor_map)
        seconds = time.monotonic() - started
        exports.write_exports(staging, options.export, mapper)
        _write_run(staging, inputs, options, files, mapper)
    return _report(inputs, mapper, area, seconds, output, note)


def _with_networks(options: StitchOptions) -> MapperOptions:
    told, files = options.mapper, options.networks
    method = told.features.method
    return replace(
        told,
        features=with_point_network(told.features, files, method),
        matching=with_match_network(told.matching, files, method),
    )


def _locate(
    mapper: Mapper,
    inputs: Inputs,
    options: StitchOptions,
    readings: Telemetry,
    staging: Path,
    progress: Progress,
) -> str:
    """First walk: every frame to its pose or its reason; return the clocks' offset if found."""
    total = len(inputs.files)
    work = partial(_read_and_prepare, mapper)
    for done, prepared in enumerate(ordered(work, inputs.files, options.workers), start=1):
        mapper.step(prepared)
        if options.debug:
            _draw_trials(mapper.trials, staging / "matches")
        progress("locating", done, total)
    note = feed_shifted(mapper, readings) if readings.find_time_offset else ""
    mapper.finish()
    return note


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
    """Return a frame's view, its chosen points in that view's pixels, and pixel_from_metres.

    Of a keyframe from long ago only half the resolution is kept.
    """
    assert prepared.features is not None
    if prepared.view is not None:
        image, pixel_from_metres = prepared.view.image, prepared.view.grid.pixel_from_metres
    else:
        first = prepared.levels[0]
        image, pixel_from_metres = first.image, first.pixel_from_metres
    points = apply_homography(pixel_from_metres, prepared.features.points[chosen])
    return view.to_colour(image), points, pixel_from_metres


def _read_and_prepare(mapper: Mapper, file: FrameFile) -> Prepared:
    try:
        return mapper.prepare(read_frame(file))
    except FrameError as error:
        return Prepared(file.index, file.name, file.stamp, None, None, str(error))


def _write_maps(
    inputs: Inputs,
    estimates: Sequence[PoseEstimate],
    options: StitchOptions,
    staging: Path,
    progress: Progress,
) -> float:
    """Second walk: paint every fragment; return the floor seen in all, in square metres.

    By the frames that are tracked: what a predicted one shows was of no use to place it.
    """
    fragments = placed_fragments(estimates)
    total = sum(estimate.status == "tracked" for estimate in estimates)
    metres_per_pixel = options.metres_per_pixel or camera.default_metres_per_pixel(
        inputs.calibration
    )
    area, done = 0.0, 0
    for fragment, members in fragments.items():
        suffix = "" if fragment == 0 else f"_{fragment}"
        painter = Painter(inputs.calibration, metres_per_pixel)
        seen = [estimate for estimate in members if estimate.status == "tracked"]
        _check_extent(painter, seen)
        canvas = Canvas(metres_per_pixel)
        jobs = [(inputs.files[e.index], e.map_from_robot) for e in seen if e.map_from_robot]
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


def _paint(painter: Painter, job: tuple[FrameFile, Pose2]) -> Tile:
    file, map_from_robot = job
    return painter.patch(read_frame(file), map_from_robot)


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
    files: TelemetryFiles,
    mapper: Mapper,
) -> None:
    estimates = mapper.estimates
    sections: dict[str, dict[str, tables.Scalar]] = {
        "": {
            "version": __version__,
            "calibration": str(inputs.calibration_path) if inputs.calibration_path else None,
            "unit": inputs.calibration.unit,
            "first_frame": str(inputs.files[0].path),
            "registration_metres_per_pixel": mapper.metres_per_pixel,
            "odometry": str(files.odometry) if files.odometry else None,
            "compass": str(files.compass) if files.compass else None,
            "gps": str(files.gps) if files.gps else None,
        }
    }
    for section, key, value in tables.flatten(options):
        sections.setdefault(f"options.{section}".rstrip("."), {})[key] = value
    sections["counts"] = {
        "frames": len(estimates),
        "placed": sum(e.map_from_robot is not None for e in estimates),
        "predicted": sum(e.status == "predicted" for e in estimates),
        "lost": sum(e.status == "lost" for e in estimates),
        "fragments": len(placed_fragments(estimates)),
        "links": len(mapper.links),
        "switched_off": len(mapper.switched_off),
    }
    for fragment, georeference in mapper.georeferences.items():
        name = "georeference" if fragment == 0 else f"georeference_{fragment}"
        sections[name] = exports.georeference_table(georeference)
    tables.write_toml(staging / "run.toml", sections)


def _report(
    inputs: Inputs,
    mapper: Mapper,
    area_square_metres: float,
    seconds: float,
    output: Path,
    time_offset: str,
) -> StitchReport:
    """Return the closing table; exit 1 when a sequence of frames yields no map at all."""
    estimates = mapper.estimates
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
    predicted = sum(e.status == "predicted" for e in estimates)
    if predicted:
        rows.append(("predicted", f"{predicted}, carried by odometry"))
    if mapper.switched_off:
        rows.append(("links off", f"{len(mapper.switched_off)}, contradicted by the others"))
    if time_offset:
        rows.append(("time offset", time_offset))
    rows += [("on Earth", exports.tell(found)) for found in mapper.georeferences.values()]
    if mapper.senses.datum_degrees is not None and not mapper.georeferences:
        rows.append(("on Earth", "not known: the way is too short for what the GPS tells"))
    rows += [("lost", f"{e.name}: {e.reason}") for e in estimates if e.status == "lost"]
    rows += [
        ("path length", f"{length:.3f} {unit}"),
        ("area", f"{area_square_metres:.3f} {unit}²"),
        ("time", f"{seconds:.1f} s, {len(estimates) / seconds:.1f} frames/s"),
        ("written to", str(output)),
    ]
    lines = [inputs.note] if inputs.note else []
    lines += [f"{name:<12} {value}" for name, value in rows]
    return StitchReport(tuple(lines), 0 if placed else 1)
