"""What `slam stitch` tells when it is done: the closing table and run.toml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from slamcli import __version__
from slamcli.core.geometry import path_length
from slamcli.core.records import PoseEstimate
from slamcli.io import runs, toml
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.mapping.mapper import Mapper
from slamcli.run.calibrate.self_calibration import describe, run_section
from slamcli.run.inputs import Inputs
from slamcli.run.networks import LEARNED
from slamcli.run.stitch import exports
from slamcli.run.stitch.options import StitchOptions
from slamcli.run.telemetry import TelemetryFiles
from slamcli.selfcal import SelfCalibration

# The exit code of a program that SIGINT ended.
_INTERRUPTED = 130


@dataclass(frozen=True, slots=True, eq=False)
class StitchReport:
    """What came of it, as the lines of the closing table, and the exit code."""

    lines: tuple[str, ...]
    exit_code: int


def write_run(
    path: Path,
    sources: Sequence[Path],
    inputs: Inputs,
    options: StitchOptions,
    files: TelemetryFiles,
    estimates: Sequence[PoseEstimate],
    mapper: Mapper,
    refined: SelfCalibration | None,
) -> None:
    """Write run.toml: what was told, and what came of it."""
    sections: dict[str, dict[str, toml.Scalar]] = {
        "": {
            "version": __version__,
            "calibration": str(inputs.calibration_path) if inputs.calibration_path else None,
            "unit": inputs.calibration.unit,
            "first_frame": str(inputs.files[0].path),
            "sources": runs.source_text(sources),
            "registration_metres_per_pixel": mapper.metres_per_pixel,
            "odometry": str(files.odometry) if files.odometry else None,
            "compass": str(files.compass) if files.compass else None,
            "gps": str(files.gps) if files.gps else None,
        }
    }
    sections["camera"] = runs.camera_section(inputs.calibration)
    for section, key, value in toml.flatten(replace(options, resume=False)):
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
    if refined is not None:
        sections["self_calibration"] = run_section(refined)
    toml.write_toml(path, sections)


def report(
    inputs: Inputs,
    estimates: Sequence[PoseEstimate],
    mapper: Mapper,
    area_square_metres: float,
    seconds: float,
    output: Path,
    time_offset: str,
    refined: SelfCalibration | None,
    *,
    interrupted: bool,
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
        *_said_of_telemetry(estimates, mapper, time_offset),
    ]
    rows += [("lost", f"{e.name}: {e.reason}") for e in estimates if e.status == "lost"]
    rows += [
        ("path length", f"{length:.3f} {unit}"),
        ("area", f"{area_square_metres:.3f} {unit}²"),
        ("time", f"{seconds:.1f} s, {len(estimates) / seconds:.1f} frames/s"),
        ("written to", str(output)),
    ]
    lines = [inputs.note] if inputs.note else []
    method = mapper.options.features.method
    if method in LEARNED:
        rows.append(("map.slam", f"to render; slam locate and --extend do not take {method}"))
    if interrupted:
        lines.append("interrupted: written is what there was; --resume goes on from there")
    lines += [f"{name:<12} {value}" for name, value in rows]
    lines += [] if refined is None else describe(refined)
    code = _INTERRUPTED if interrupted else 0 if placed else 1
    return StitchReport(tuple(lines), code)


def _said_of_telemetry(
    estimates: Sequence[PoseEstimate], mapper: Mapper, time_offset: str
) -> list[tuple[str, str]]:
    rows = []
    predicted = sum(e.status == "predicted" for e in estimates)
    if predicted:
        rows.append(("predicted", f"{predicted}, carried by odometry"))
    if mapper.switched_off:
        rows.append(("links off", f"{len(mapper.switched_off)}, contradicted by the others"))
    if time_offset:
        rows.append(("time offset", time_offset))
    rows += [("on Earth", exports.tell(found)) for found in mapper.georeferences.values()]
    if mapper.sensors.datum_degrees is not None and not mapper.georeferences:
        rows.append(("on Earth", "not known: the way is too short for what the GPS tells"))
    return rows
