"""`slam evaluate`: the errors of poses against true ones, as lines and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from slamcli.core.errors import InputError
from slamcli.core.trajectory import Accuracy, Evaluation, Statistics, Trajectory
from slamcli.drawing.errors import SUFFIXES, check_plots, plot_errors
from slamcli.io.error_table import TABLES, table_rows
from slamcli.io.files import write_bytes, write_text
from slamcli.io.outputs import refuse_existing
from slamcli.io.trajectories import poses_file, read_trajectory
from slamcli.stages.evaluation import error_series
from slamcli.stages.evaluation import evaluate as evaluate_poses


@dataclass(frozen=True, slots=True)
class EvaluateReport:
    """The errors as lines to print and as JSON.

    Attributes
    ----------
    lines : tuple of str
    json : str
    """

    lines: tuple[str, ...]
    json: str


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """How trajectories are compared, and what is written.

    Attributes
    ----------
    tolerance_seconds : float
        Largest difference of the stamps of two poses that are compared.
    delta : int
        Poses over which the relative error is measured.
    plot : Path or None
        A figure (.pdf, .svg or .png).
    table : Path or None
        A table (.csv, or .tex for LaTeX).
    overwrite : bool
        Replace earlier ones.
    """

    tolerance_seconds: float = 0.01
    delta: int = 1
    plot: Path | None = None
    table: Path | None = None
    overwrite: bool = False


def evaluate(poses: Sequence[Path], truth: Path, options: EvaluateOptions) -> EvaluateReport:
    """Compare files of poses with a file of true ones, each in any format that can be read.

    A folder stands for the file of poses in it.

    Raises
    ------
    InputError, OutputError
    """
    _check_outputs([poses_file(path) for path in (*poses, truth)], options)
    true = _read(truth)
    estimates = {str(path): _read(path) for path in poses}
    found = {
        name: evaluate_poses(
            estimate, true, tolerance_seconds=options.tolerance_seconds, delta=options.delta
        )
        for name, estimate in estimates.items()
    }
    if options.plot is not None:
        series = [
            error_series(name, estimate, true, options.tolerance_seconds)
            for name, estimate in estimates.items()
        ]
        suffix = options.plot.suffix.lower()
        write_bytes(options.plot, plot_errors(series, true.poses[:, :2], suffix))
    if options.table is not None:
        write = TABLES[options.table.suffix.lower()]
        write_text(options.table, write(table_rows(found)))
    lines, data = list[str](), {name: _without_nan(asdict(one)) for name, one in found.items()}
    for name, one in found.items():
        lines += [*([name] if len(found) > 1 else []), *_lines(one)]
    lines += [f"wrote {path}" for path in (options.plot, options.table) if path is not None]
    whole = data if len(data) > 1 else next(iter(data.values()))
    return EvaluateReport(tuple(lines), json.dumps(whole, indent=2, ensure_ascii=False))


def _check_outputs(inputs: Sequence[Path], options: EvaluateOptions) -> None:
    """Refuse, before the work, what could not be written after it."""
    for path, suffixes in ((options.plot, SUFFIXES), (options.table, tuple(TABLES))):
        if path is None:
            continue
        if path.suffix.lower() not in suffixes:
            raise InputError(
                f"cannot write {path}: give a name that ends in {' or '.join(suffixes)}"
            )
        refuse_existing(path, inputs=inputs, overwrite=options.overwrite)
    if options.plot is not None:
        check_plots()


def _read(path: Path) -> Trajectory:
    trajectory = read_trajectory(path)
    if not len(trajectory):
        raise InputError(f"{path} has no frame with a pose")
    return trajectory


def _lines(found: Evaluation) -> list[str]:
    lines = [
        f"{found.matched} poses of {found.truth_poses} true ones compared by {found.matched_by}; "
        f"{found.unplaced} frames not placed"
    ]
    if len(found.fragments) > 1:
        for part in found.fragments:
            lines += [f"fragment {part.fragment}", *_describe(part)]
        lines.append("all fragments, each aligned for itself")
    return [*lines, *_describe(found.whole)]


def _describe(part: Accuracy) -> list[str]:
    share = part.absolute_share_of_path
    of_path = "" if math.isnan(share) else f" ({share:.4%} of the path)"
    steps = "pose to pose" if part.delta == 1 else f"over {part.delta} poses"
    lines = [
        f"  path          {part.path_metres:.3f} m, {part.poses} poses",
        f"  ATE           {_statistics(part.absolute, ' mm', of_path)}",
        f"  heading       {_statistics(part.heading, '°')}",
        f"  RPE           {_statistics(part.relative, ' mm')}, {steps}",
        f"  RPE heading   {_statistics(part.relative_heading, '°')}, {steps}",
    ]
    if part.consistency is not None:
        lines.append(
            f"  NEES          {part.consistency.nees:.2f} (3 when the sigmas are honest), "
            f"{part.consistency.within_95_percent:.0%} of the poses within their 95 % bound"
        )
    return lines


def _statistics(errors: Statistics, unit: str, remark: str = "") -> str:
    if math.isnan(errors.rmse):
        return "too few poses"
    scale = 1000.0 if unit == " mm" else 1.0
    return (
        f"rmse {scale * errors.rmse:.4g}{unit}{remark}, mean {scale * errors.mean:.4g}{unit}, "
        f"median {scale * errors.median:.4g}{unit}, largest {scale * errors.largest:.4g}{unit}"
    )


def _without_nan(value: Any) -> Any:
    """Return the same with None in place of nan, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and math.isnan(value) else value
