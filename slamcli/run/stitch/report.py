"""What `slam stitch` reports at its end: the closing table with the exit code, and run.toml."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

from slamcli import __version__
from slamcli.core.exit_codes import ExitCode, of_placement
from slamcli.core.geometry import path_length
from slamcli.io import runs, toml
from slamcli.mapping.backend.pose_graph import placed_fragments
from slamcli.run.command_report import Report
from slamcli.run.networks import LEARNED
from slamcli.run.paint.outputs import PaintedMaps, counted
from slamcli.run.report.run import FinishedRun
from slamcli.run.self_calibration import describe, run_section
from slamcli.run.session.session import Session
from slamcli.run.stitch import exports
from slamcli.run.stitch.drive import Drive, LocatedDrive


def report(
    located: LocatedDrive,
    painted: PaintedMaps,
    output: Path,
    seconds: float,
    *,
    interrupted: bool,
) -> Report:
    """Return the closing table; its first lines give the reason of any exit code but 0."""
    estimates = located.estimates
    placed = [e.map_from_robot for e in estimates if e.map_from_robot is not None]
    code = of_placement(len(placed), len(estimates), strict=located.drive.options.strict)
    lines = [located.note] if located.note else []
    if interrupted:
        code = ExitCode.INTERRUPTED
        lines.append("interrupted: written is what there was; --resume continues from there")
    elif code == ExitCode.INCOMPLETE:
        lines.append(f"incomplete: {len(placed)} of {len(estimates)} placed")
    if located.vanished:
        lines.append(f"incomplete: {counted(located.vanished)} vanished before being located")
    if painted.note:
        lines.append(painted.note)
    if located.vanished or painted.note:
        code = ExitCode.INCOMPLETE if code == ExitCode.DONE else code
        lines.append("put them back, and --resume continues from what was located before")
    rows = [
        *_map_rows(located, painted),
        ("time", f"{seconds:.1f} s, {located.reached / seconds:.1f} frames/s"),
        ("written to", f"{output}; to look at it: {shlex.join(['slam', 'view', str(output)])}"),
        *_use_rows(located),
    ]
    lines += [f"{name:<12} {value}" for name, value in rows]
    if located.camera_note:
        lines.append(f"{'camera':<12} {located.camera_note}")
    if located.self_calibration is not None:
        lines += describe(located.self_calibration)
    facts = {**_facts(located, painted), "seconds": seconds, "output": output}
    return Report(tuple(lines), facts, code)


def _facts(located: LocatedDrive, painted: PaintedMaps) -> dict[str, object]:
    """Return what the closing table says, for a program."""
    estimates = located.estimates
    facts: dict[str, object] = {
        **_counts(located),
        "unit": located.calibration.unit,
        "path_length": _path_length(located),
        "area": painted.area_square_metres,
        "lost_frames": [
            {"name": e.name, "reason": e.reason} for e in estimates if e.status == "lost"
        ],
        "vanished": located.vanished,
        "unread": painted.unread,
        "georeferences": {
            fragment: exports.georeference_table(found, located.drive.options.products.crs)
            for fragment, found in located.georeferences.items()
        },
    }
    if located.self_calibration is not None:
        facts["self_calibration"] = run_section(located.self_calibration)
    return facts


def finished(located: LocatedDrive, painted: PaintedMaps, command: str) -> FinishedRun:
    """Return the run as its page shows it."""
    drive, survey = located.drive, located.survey
    return FinishedRun(
        title=", ".join(source.resolve().name for source in drive.sources),
        note=located.note,
        # The page lists lost frames in a table of their own.
        rows=[row for row in _map_rows(located, painted) if row[0] != "lost"],
        command=command,
        files=drive.inputs.files[: located.reached],
        estimates=located.estimates,
        given=drive.inputs.calibration,
        registered=located.registered,
        mapper=located.mapper,
        georeferences=located.georeferences,
        painted=painted,
        self_calibration=located.self_calibration,
        survey=None if survey is None else survey.rows,
    )


def _use_rows(located: LocatedDrive) -> list[tuple[str, str]]:
    """Return rows on what a map of this kind can be used for."""
    rows, method = list(located.scale_rows), located.mapper.options.features.method
    if method in LEARNED:
        rows.append(("map.slam", f"to render; slam locate and --extend do not take {method}"))
    if located.survey is not None:
        rows += located.survey.rows
        rows.append(("map.slam", "slam locate takes frames about as high and level as the mean"))
    return rows


def _map_rows(located: LocatedDrive, painted: PaintedMaps) -> list[tuple[str, str]]:
    """Return the rows on the map: its fragments, the sensors' part, lost frames and its size."""
    frames, placed = len(located.estimates), sum(e.status != "lost" for e in located.estimates)
    fragments = placed_fragments(located.estimates)
    unit = located.calibration.unit
    return [
        ("frames", str(frames)),
        ("placed", f"{placed} ({placed / frames:.0%})"),
        ("fragments", str(len(fragments))),
        *_sensor_rows(located),
        *_lost_rows(located),
        ("path length", f"{_path_length(located):.3f} {unit}"),
        ("area", f"{painted.area_square_metres:.3f} {unit}²"),
    ]


def _path_length(located: LocatedDrive) -> float:
    return sum(
        path_length([e.map_from_robot for e in members if e.map_from_robot is not None])
        for members in placed_fragments(located.estimates).values()
    )


def _lost_rows(located: LocatedDrive) -> list[tuple[str, str]]:
    """Return a row for each lost frame that was looked at, and one for all the others."""
    reached = located.estimates[: located.reached]
    rows = [("lost", f"{e.name}: {e.reason}") for e in reached if e.status == "lost"]
    left = [estimate.name for estimate in located.estimates[located.reached :]]
    return [*rows, ("not reached", counted(left))] if left else rows


def _sensor_rows(located: LocatedDrive) -> list[tuple[str, str]]:
    rows, mapper = [], located.mapper
    predicted = sum(e.status == "predicted" for e in located.estimates)
    if predicted:
        rows.append(("predicted", f"{predicted}, carried by odometry"))
    if mapper.switched_off:
        rows.append(("links off", f"{len(mapper.switched_off)}, contradicted by the others"))
    if located.time_offset:
        rows.append(("time offset", located.time_offset))
    sensors = mapper.sensors
    if sensors.odometry_readings:
        compared = f"compared with {sensors.compared} frames, no contradiction"
        rows.append(("odometry", f"{sensors.odometry_readings} readings, {compared}"))
    rows += [("sensors", fault) for fault in sensors.faults]
    rows += [("on Earth", exports.describe(found)) for found in located.georeferences.values()]
    known = bool(located.georeferences or sensors.gps_fault)
    if sensors.datum_degrees is not None and not known:
        rows.append(("on Earth", "not known: the way is too short for the accuracy of the GPS"))
    return rows


def write_run(path: Path, located: LocatedDrive, session: Session) -> None:
    """Write run.toml: inputs, camera, options, and the counts of the result."""
    sections = {"": _inputs_section(located), "camera": runs.camera_section(located.calibration)}
    sections |= _option_sections(located.drive, session)
    sections["counts"] = _counts(located)
    for fragment, georeference in located.georeferences.items():
        name = "georeference" if fragment == 0 else f"georeference_{fragment}"
        sections[name] = exports.georeference_table(
            georeference, located.drive.options.products.crs
        )
    if located.self_calibration is not None:
        sections["self_calibration"] = run_section(located.self_calibration)
    if located.survey is not None:
        sections["survey"] = located.survey.section
    toml.write_toml(path, sections)


def _counts(located: LocatedDrive) -> dict[str, toml.Scalar]:
    """Return the counts of the result."""
    estimates, mapper = located.estimates, located.mapper
    return {
        "frames": len(estimates),
        "placed": sum(e.map_from_robot is not None for e in estimates),
        "predicted": sum(e.status == "predicted" for e in estimates),
        "lost": sum(e.status == "lost" for e in estimates),
        "fragments": len(placed_fragments(estimates)),
        "links": len(located.registered.links) if located.survey else len(mapper.links),
        "switched_off": len(mapper.switched_off),
    }


def _inputs_section(located: LocatedDrive) -> dict[str, toml.Scalar]:
    inputs, files = located.drive.inputs, located.drive.telemetry_files
    return {
        "version": __version__,
        "calibration": str(inputs.calibration_path) if inputs.calibration_path else None,
        "unit": located.calibration.unit,
        "first_frame": str(inputs.files[0].path.absolute()),
        "sources": runs.source_text(located.drive.sources),
        "registration_metres_per_pixel": located.mapper.metres_per_pixel,
        "odometry": str(files.odometry) if files.odometry else None,
        "compass": str(files.compass) if files.compass else None,
        "gps": str(files.gps) if files.gps else None,
        "time_offset": "auto" if files.find_time_offset else None,
    }


def _option_sections(drive: Drive, session: Session) -> dict[str, dict[str, toml.Scalar]]:
    sections: dict[str, dict[str, toml.Scalar]] = {}
    for section, key, value in toml.flatten(replace(drive.options, resume=False)):
        sections.setdefault(f"options.{section}".rstrip("."), {})[key] = value
    sections["options"] |= {"workers": session.workers, "scheduler": session.scheduler}
    return sections
